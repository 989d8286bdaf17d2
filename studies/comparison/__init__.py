# SPDX-License-Identifier: Apache-2.0
"""A comparison with other observers: the same tuning for all, scenarios, tables."""
