# SPDX-License-Identifier: Apache-2.0
"""What noise, and which unknown input, a recorded y shows by itself; and the gains for them."""
