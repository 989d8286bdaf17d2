# SPDX-License-Identifier: Apache-2.0
"""Fuzzy-based super-twisting adaptive-order sliding mode observer for ROS 2 and plain Python."""

__version__ = '0.1.0'
