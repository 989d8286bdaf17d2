# SPDX-License-Identifier: Apache-2.0
"""Studies: the paper, the comparison, recipes, the parameter reference; not installed."""
