# SPDX-License-Identifier: Apache-2.0
"""An honest comparison: other observers, the same tuning for all, scenarios, tables."""
