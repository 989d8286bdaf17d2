# SPDX-License-Identifier: Apache-2.0
"""The command demo: plant and estimator over DDS, recorded, with a table and a figure."""
