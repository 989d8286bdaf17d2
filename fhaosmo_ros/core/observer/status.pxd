# SPDX-License-Identifier: Apache-2.0
"""The flags of `Status` (status.py, which says what each means) for compiled code."""

cdef enum:
    REJECTED_MEASUREMENT = 1
    REJECTED_PERIOD = 2
    REJECTED_INPUT = 4
    REJECTED_STEP = 8
    GAMMA_AT_MIN = 16
    GAMMA_AT_MAX = 32
    SENSITIVITY_RESET = 64
    REJECTED_SPIKE = 128
    REJECTED_STUCK = 256
    HELD = 512
    GAP = 1024
    RESTARTED = 2048
    DIVERGED = 4096
    JUMPED = 8192
    REPEATED = 16384
    REJECTED = 1 + 2 + 4 + 8 + 128 + 256
    UNUSED = 1 + 2 + 4 + 8 + 128 + 256 + 16384
    LEVEL_SHIFT = 16
    FLAGS_MASK = 65535
