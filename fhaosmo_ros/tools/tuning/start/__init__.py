# SPDX-License-Identifier: Apache-2.0
"""Where a search begins: gains from theory and from Kalman filters."""
