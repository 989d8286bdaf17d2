# SPDX-License-Identifier: Apache-2.0
"""What commands share: how they run, their options, child processes."""
