# SPDX-License-Identifier: Apache-2.0
"""What compiled code needs: where its machine code is cached, and arrays without an owner."""
