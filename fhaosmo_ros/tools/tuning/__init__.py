# SPDX-License-Identifier: Apache-2.0
"""Finding parameters of an estimator that fit a sensor."""
