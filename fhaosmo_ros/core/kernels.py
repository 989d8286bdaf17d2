# SPDX-License-Identifier: Apache-2.0
"""
A step of either structure: what is refused, the gamma law, and runs of steps.

Equations are cited as P (paper: label of the equation) and D (number in docs/mathematics.md).
The state's layout is described in layout.py, the recursions in cascade.py and levant.py.
"""

import math

from fhaosmo_ros.core import cascade, levant
from fhaosmo_ros.core.borrowed import borrowed
from fhaosmo_ros.core.law import (
    ADAPTIVE,
    DEAD_ZONE,
    DELAY,
    EPSILON,
    FROM_MEASUREMENT,
    GAMMA_INITIAL,
    IMPLICIT,
    LEAKAGE,
    LEVANT,
    MAX,
    MIN,
    PREDICTING,
    RATE,
)  # fmt: skip
from fhaosmo_ros.core.layout import (
    GAMMA,
    HAT,
    HAT_SENSITIVITY,
    PENDING,
    ROWS,
    TILDE,
    TILDE_SENSITIVITY,
    WAIT,
    Y,
)
from fhaosmo_ros.core.status import LEVEL_SHIFT, Status
from fhaosmo_ros.core.tape import Floats, Ints
from numba import njit

# Plain integers: numba reads them as constants.
REJECTED_MEASUREMENT = int(Status.REJECTED_MEASUREMENT)
REJECTED_PERIOD = int(Status.REJECTED_PERIOD)
REJECTED_INPUT = int(Status.REJECTED_INPUT)
REJECTED_STEP = int(Status.REJECTED_STEP)
AT_MIN = int(Status.GAMMA_AT_MIN)
AT_MAX = int(Status.GAMMA_AT_MAX)
SENSITIVITY_RESET = int(Status.SENSITIVITY_RESET)

SENSITIVITY_LIMIT = 1e9
HEADROOM = 1e8
"""A number counts as infinite if this many times it would be: differences then stay finite."""


@njit(cache=True, error_model='numpy', forceinline=True)
def innovations(scalars: Floats, levels: Floats, y: float, eps: Floats, row: int) -> int:
    """Write eps_i = m_i - z_hat_i into a row of `eps`; return the number of open levels."""
    count, running = 0, True
    for i in range(levels.shape[1]):
        m = y if i == 0 else levels[TILDE, i - 1]
        eps[row, i] = m - levels[HAT, i]
        if running:
            count += 1
        running = running and abs(eps[row, i]) <= scalars[EPSILON]  # P Eifunction
    return count


@njit(cache=True, error_model='numpy', forceinline=True)
def start(
    flags: Ints, scalars: Floats, levels: Floats, memory: Floats, y: float, eps: Floats, row: int
) -> int:
    """
    Take `y` as the first sample if it is one: time has not passed, nothing is integrated.

    Returns
    -------
    int
        Status word (see status.py).

    """
    word = 0
    if math.isfinite(HEADROOM * y):
        memory[Y] = y
        memory[PENDING] = 0.0
        if flags[FROM_MEASUREMENT]:
            levels[HAT, 0] = y
    else:
        word = REJECTED_MEASUREMENT
    return word | (innovations(scalars, levels, memory[Y], eps, row) << LEVEL_SHIFT)


@njit(cache=True, error_model='numpy', forceinline=True)
def step(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    levels: Floats, memory: Floats, y: float, h: float, u: float, eps: Floats, row: int,
) -> int:  # fmt: skip
    """
    Advance a state in place to the sample `y` that lies `h` seconds after the last call.

    Returns
    -------
    int
        Status word (see status.py). A rejected sample changes no level; see `Status`.

    """
    n = gains.shape[1]
    word = 0
    if not math.isfinite(HEADROOM * y):
        word |= REJECTED_MEASUREMENT
    if not math.isfinite(u):
        word |= REJECTED_INPUT
    if not (h > 0.0 and math.isfinite(HEADROOM * h)):
        word |= REJECTED_PERIOD
    if not word:
        for r in range(ROWS):
            for i in range(n):
                x[r, i] = levels[r, i]
        gamma, whole = memory[GAMMA], h + memory[PENDING]
        if flags[LEVANT]:
            if flags[PREDICTING]:
                loss, gradient = levant.predict_correct(
                    flags, gains, curves, scalars, tape, offsets, x, m, stack, gamma, y, whole, u
                )
            elif flags[IMPLICIT]:
                loss, gradient = levant.implicit(
                    flags, gains, curves, tape, offsets, x, m, stack, gamma, y, whole, u
                )
            else:
                loss, gradient = levant.explicit(
                    flags, gains, curves, tape, offsets, x, m, stack, gamma, memory[Y], whole, u
                )
        elif flags[IMPLICIT]:
            loss, gradient = cascade.implicit(
                flags, gains, curves, scalars, tape, offsets, x, m, stack, gamma, y, whole, u
            )
        else:
            loss, gradient = cascade.explicit(
                flags, gains, curves, scalars, tape, offsets,
                x, m, stack, gamma, memory[Y], whole, u,
            )  # fmt: skip
        zero = 0.0
        for i in range(n):
            hat, tilde = HEADROOM * x[HAT, i], HEADROOM * x[TILDE, i]
            zero += (hat - hat) + (tilde - tilde)
        if zero != 0.0:  # a difference of equals is 0, and NaN if they are not finite
            word = REJECTED_STEP
            # Nothing of the sample may make the next step fail as well: not its time, and not
            # the y at the interval's beginning, which is what fails explicitly.
            memory[PENDING] = 0.0
            if not flags[IMPLICIT]:
                memory[Y] = y
        else:
            if flags[ADAPTIVE]:
                memory[GAMMA], memory[WAIT], word = adapt(
                    scalars, x, gamma, memory[WAIT], whole, loss, gradient
                )
            for r in range(ROWS):
                for i in range(n):
                    levels[r, i] = x[r, i]
            memory[Y] = y
            memory[PENDING] = 0.0
    if word & (REJECTED_MEASUREMENT | REJECTED_INPUT) and not word & REJECTED_PERIOD:
        memory[PENDING] += h
    return word | (innovations(scalars, levels, memory[Y], eps, row) << LEVEL_SHIFT)


@njit(cache=True, error_model='numpy', forceinline=True)
def adapt(
    c: Floats, x: Floats, gamma: float, wait: float, h: float, loss: float, gradient: float
) -> tuple[float, float, int]:
    """
    Return the next gamma (P adaptationlawgamma), the time to wait, and the status flags.

    Projection on [gamma_min, gamma_max], dead zone and leakage are ours (D 8).
    """
    word = 0
    zero = gradient - gradient
    for r in (HAT_SENSITIVITY, TILDE_SENSITIVITY):
        for i in range(x.shape[1]):
            if not abs(x[r, i]) < SENSITIVITY_LIMIT:
                word = SENSITIVITY_RESET
    if word or zero != 0.0:
        word = SENSITIVITY_RESET
        for r in (HAT_SENSITIVITY, TILDE_SENSITIVITY):
            for i in range(x.shape[1]):
                x[r, i] = 0.0
    leaks = c[DEAD_ZONE] == 0.0
    if loss <= c[DEAD_ZONE] * c[DEAD_ZONE]:  # adaptation rests
        leaks = leaks or wait <= 0.0
        wait = max(wait - h, 0.0)
    else:
        wait = c[DELAY]
        if not word:
            gamma -= h * c[RATE] * gradient  # P adaptationlawgamma
    if leaks:
        gamma -= min(h * c[LEAKAGE], 1.0) * (gamma - c[GAMMA_INITIAL])
    if not gamma > c[MIN]:  # also for NaN, from an infinite gradient step
        gamma = c[MIN]
        word |= AT_MIN
    elif gamma >= c[MAX]:
        gamma = c[MAX]
        word |= AT_MAX
    return gamma, wait, word


@njit(cache=True, error_model='numpy')
def step_once(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    levels: Floats, memory: Floats, y: float, h: float, u: float, eps: Floats,
) -> int:  # fmt: skip
    """Advance by one sample; see `step`. The innovations go to eps[0]."""
    return step(
        flags, gains, curves, scalars, tape, offsets, x, m, stack,
        levels, memory, y, h, u, eps, 0,
    )  # fmt: skip


@njit(cache=True, error_model='numpy')
def run(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    levels: Floats, memory: Floats, y: Floats, h: Floats, u: Floats,
    out: Floats, gamma: Floats, eps: Floats, words: Ints, first: int, every: int,
) -> None:  # fmt: skip
    """
    Start with the samples before index `first`, step from it on; record every `every`-th one.

    Row r of `out` (rows, 2, N), `gamma`, `eps` and `words` is the state after sample
    (r + 1) * every - 1; `eps` has one row more, for the samples after the last such one.
    """
    flags, gains, curves, scalars = (
        borrowed(flags), borrowed(gains), borrowed(curves), borrowed(scalars)
    )  # fmt: skip
    tape, offsets = borrowed(tape), borrowed(offsets)
    x, m, stack = borrowed(x), borrowed(m), borrowed(stack)
    levels, memory, eps = borrowed(levels), borrowed(memory), borrowed(eps)
    row, seen = 0, 0
    for k in range(y.shape[0]):
        if k >= first:
            word = step(
                flags, gains, curves, scalars, tape, offsets, x, m, stack,
                levels, memory, y[k], h[k], u[k], eps, row,
            )  # fmt: skip
        else:
            word = start(flags, scalars, levels, memory, y[k], eps, row)
        seen |= word & ((1 << LEVEL_SHIFT) - 1)
        if (k + 1) % every == 0:
            for i in range(levels.shape[1]):
                out[row, HAT, i] = levels[HAT, i]
                out[row, TILDE, i] = levels[TILDE, i]
            gamma[row] = memory[GAMMA]
            words[row] = (word >> LEVEL_SHIFT << LEVEL_SHIFT) | seen
            seen = 0
            row += 1
