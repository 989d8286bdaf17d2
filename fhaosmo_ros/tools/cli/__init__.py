# SPDX-License-Identifier: Apache-2.0
"""What commands share: how they run, child processes."""
