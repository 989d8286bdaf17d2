# SPDX-License-Identifier: Apache-2.0
"""Studies: the paper, the comparison, the parameter reference. `make` runs them; not installed."""
