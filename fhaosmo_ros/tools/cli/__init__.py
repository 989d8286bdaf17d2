# SPDX-License-Identifier: Apache-2.0
"""The protocol of all commands: options, output, signals, child processes."""
