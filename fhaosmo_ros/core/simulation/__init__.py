# SPDX-License-Identifier: Apache-2.0
"""Simulated plants and disturbances, recordings of them, and how an estimate is scored."""
