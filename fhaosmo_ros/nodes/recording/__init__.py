# SPDX-License-Identifier: Apache-2.0
"""Nodes that tools make for themselves, to record topics and to play them."""
