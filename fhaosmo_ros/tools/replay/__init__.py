# SPDX-License-Identifier: Apache-2.0
"""The command replay: estimates from a recorded y."""
