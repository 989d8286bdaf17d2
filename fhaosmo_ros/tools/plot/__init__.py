# SPDX-License-Identifier: Apache-2.0
"""The command plot: figures and metrics of the estimates in bags."""
