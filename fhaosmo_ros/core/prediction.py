# SPDX-License-Identifier: Apache-2.0
"""The plant's model run ahead from the estimates: what y does where no sample says so."""

import math

from fhaosmo_ros.core.layout import TILDE, Y
from fhaosmo_ros.core.tape import evaluate, Floats, Ints
from numba import njit


@njit(cache=True, error_model='numpy')
def estimates(levels: Floats, memory: Floats, z: Floats) -> None:
    """Write z_1 .. z_n and d into `z` (n + 1): the last sample, and the internal estimates."""
    z[0] = memory[Y]
    for i in range(1, z.shape[0]):
        z[i] = levels[TILDE, i - 1]


@njit(cache=True, error_model='numpy')
def advance(
    tape: Floats, offsets: Ints, m: Floats, stack: Floats, decay: float,
    z: Floats, h: float, u: float,
) -> None:  # fmt: skip
    """Integrate P triangular over `h` in place, by the midpoint rule; d' = -decay d (D 15)."""
    n = z.shape[0] - 1
    shrink = math.exp(-0.5 * h * decay)
    for i in range(n):
        m[0, i], m[1, i] = z[i], 0.0
    for fraction in (0.5, 1.0):
        below = z[n]
        for i in range(n - 1, -1, -1):  # Phi_i reads z_1 .. z_i, which are still there
            phi, _ = evaluate(tape, offsets[i], offsets[i + 1], m, u, stack)
            here = m[0, i]
            m[0, i] = z[i] + fraction * h * (below + phi)
            below = here
        z[n] *= shrink
    for i in range(n):
        z[i] = m[0, i]


@njit(cache=True, error_model='numpy')
def ahead(
    tape: Floats, offsets: Ints, m: Floats, stack: Floats, decay: float,
    levels: Floats, memory: Floats, z: Floats, h: float, u: float, count: int,
) -> float:  # fmt: skip
    """Return y after `count` steps of `h` from the present estimates; `z` is scratch (n + 1)."""
    estimates(levels, memory, z)
    for _ in range(count):
        advance(tape, offsets, m, stack, decay, z, h, u)
    return float(z[0])
