# SPDX-License-Identifier: Apache-2.0
"""The observer: the recursion (cascade, Levant), its fuzzy curve, one step, class Observer."""
