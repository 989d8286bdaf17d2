# SPDX-License-Identifier: Apache-2.0
"""The observer's model on its own: what it says of the time between two samples (D 1, D 17)."""

import math

from fhaosmo_ros.core.layout import HAT, HAT_SENSITIVITY, TILDE, TILDE_SENSITIVITY, Y
from fhaosmo_ros.core.tape import evaluate, Floats, Ints
from numba import njit

MOST_STEPS = 4000
"""Of one flow, whatever the interval: bounds what a sample may cost."""


@njit(cache=True, error_model='numpy')
def flow(
    tape: Floats, offsets: Ints, m: Floats, stack: Floats, x: Floats, h: float, u: float
) -> None:
    """
    Integrate D 1 and D 17 over `h` in place, by a Runge-Kutta step, with their gamma derivatives.

    Parameters
    ----------
    m : (2, N) array
        Scratch memory.
    x : (4, N) array
        Rows HAT, HAT_SENSITIVITY: z_1 .. z_n, d, .. and their derivatives along gamma. The other
        rows are scratch memory.

    """
    n = x.shape[1]
    for i in range(n):
        m[0, i], m[1, i] = x[HAT, i], x[HAT_SENSITIVITY, i]
        x[TILDE, i], x[TILDE_SENSITIVITY, i] = x[HAT, i], x[HAT_SENSITIVITY, i]
    for stage in range(4):
        share = h / 6.0 if stage == 0 or stage == 3 else h / 3.0
        to_next = 0.5 * h if stage < 2 else h
        above, dabove = 0.0, 0.0
        for i in range(n - 1, -1, -1):  # Phi_i reads z_1 .. z_i, which are still there
            slope, dslope = above, dabove
            if offsets[i + 1] > offsets[i]:
                phi, dphi = evaluate(tape, offsets[i], offsets[i + 1], m, u, stack)
                slope, dslope = slope + phi, dslope + dphi
            above, dabove = m[0, i], m[1, i]
            x[TILDE, i] += share * slope
            x[TILDE_SENSITIVITY, i] += share * dslope
            m[0, i] = x[HAT, i] + to_next * slope
            m[1, i] = x[HAT_SENSITIVITY, i] + to_next * dslope
    for i in range(n):
        x[HAT, i], x[HAT_SENSITIVITY, i] = x[TILDE, i], x[TILDE_SENSITIVITY, i]


@njit(cache=True, error_model='numpy')
def flow_in_steps(
    tape: Floats, offsets: Ints, m: Floats, stack: Floats, x: Floats, h: float, longest: float,
    u: float,
) -> None:  # fmt: skip
    """Do what `flow` does in equal steps of at most `longest`."""
    count = 1
    if h > longest:
        count = int(min(math.ceil(h / longest * (1.0 - 1e-9)), MOST_STEPS))
    for _ in range(count):
        flow(tape, offsets, m, stack, x, h / count, u)


@njit(cache=True, error_model='numpy')
def estimates(levels: Floats, memory: Floats, x: Floats) -> None:
    """Write z_1 .. z_n, d, .. into `x`: the last sample, and the internal estimates."""
    for i in range(x.shape[1]):
        x[HAT, i] = levels[TILDE, i - 1] if i > 0 else memory[Y]
        x[HAT_SENSITIVITY, i] = 0.0


@njit(cache=True, error_model='numpy')
def ahead(
    tape: Floats, offsets: Ints, m: Floats, stack: Floats,
    levels: Floats, memory: Floats, x: Floats, h: float, u: float, count: int,
) -> float:  # fmt: skip
    """Return y after `count` steps of `h` from the present estimates; `x` is scratch."""
    estimates(levels, memory, x)
    for _ in range(count):
        flow(tape, offsets, m, stack, x, h, u)
    return float(x[HAT, 0])
