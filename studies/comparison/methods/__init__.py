# SPDX-License-Identifier: Apache-2.0
"""The observers that are compared, and a bound for all of them."""
