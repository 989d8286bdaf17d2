# SPDX-License-Identifier: Apache-2.0
"""Offline work with recordings of robot arms."""
