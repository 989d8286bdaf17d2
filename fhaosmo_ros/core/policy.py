# SPDX-License-Identifier: Apache-2.0
"""
The policy of time and of bad data, compiled: one function for node, replay and channels.

What it does, case by case, is in docs/operation.md; the arrays are described in policy_layout.py.
"""

from fhaosmo_ros.core import policy_layout as at
from fhaosmo_ros.core.borrowed import borrowed
from fhaosmo_ros.core.kernels import innovations, start
from fhaosmo_ros.core.layout import GAMMA, HAT, TILDE, Y
from fhaosmo_ros.core.policy_data import has_diverged, is_stuck
from fhaosmo_ros.core.policy_step import step_over
from fhaosmo_ros.core.policy_time import clock_time, difference, forget, refresh, settle
from fhaosmo_ros.core.status import LEVEL_SHIFT, REJECTED, Status
from fhaosmo_ros.core.tape import Floats, Ints
from numba import njit

REJECTED_MEASUREMENT = int(Status.REJECTED_MEASUREMENT)
REJECTED_PERIOD = int(Status.REJECTED_PERIOD)
REJECTED_STEP = int(Status.REJECTED_STEP)
REJECTED_SPIKE = int(Status.REJECTED_SPIKE)
REJECTED_STUCK = int(Status.REJECTED_STUCK)
DIVERGED = int(Status.DIVERGED)
FLAGS = (1 << LEVEL_SHIFT) - 1


@njit(cache=True, error_model='numpy', inline='always')
def take(
    stamp: int, y: float, u: float, eps: Floats, row: int, ints: Ints, reals: Floats,
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, levels: Floats, memory: Floats,
) -> int:  # fmt: skip
    """
    Take one sample of an observer.

    Parameters
    ----------
    stamp : int
        Nanoseconds.
    y, u : float
        Sample, any number, and known input, finite.
    eps : (rows, N) array
        Row `row` gets the innovations.
    ints, reals : arrays
        Settings and memory of the policy, see policy_layout.py.
    flags .. offsets, x .. stack : arrays
        `Law` and `Work`, see law.py.
    levels, memory : arrays
        The observer's state, see layout.py.

    Returns
    -------
    int
        Status word, see status.py.

    """
    word, now, elapsed = 0, stamp, 0
    if ints[at.NOMINAL]:
        ints[at.NOW] += ints[at.PERIOD]
        now = ints[at.NOW]
    elif ints[at.CLOCK]:
        now = clock_time(ints, stamp)
    if not abs(y) <= reals[at.LIMIT]:  # also NaN
        word = REJECTED_MEASUREMENT
        ints[at.REJECTED_MEASUREMENTS] += 1
    elif stamp == 0 and not ints[at.NOMINAL]:
        word = REJECTED_PERIOD
        ints[at.ZERO_STAMPS] += 1
    elif ints[at.STUCK_TIME] and is_stuck(ints, memory[Y], y, now):
        word = REJECTED_STUCK
    elif memory[Y] == memory[Y]:
        if not ints[at.TIMED]:
            forget(ints, reals, now)
        elapsed = difference(now, ints[at.LATEST])
        if 0 < elapsed <= ints[at.MAX_GAP]:
            ints[at.HELD] = 0
        else:
            elapsed, word = settle(
                flags, scalars, levels, memory, eps, ints, reals, now, elapsed, y, row
            )
    if elapsed > 0:
        word |= step_over(
            flags, gains, curves, scalars, tape, offsets, x, m, stack,
            levels, memory, eps, ints, reals, elapsed, y, u, row,
        )  # fmt: skip
    elif not word & REJECTED:  # the first sample, of all or of a new time
        word |= start(flags, scalars, levels, memory, y, eps, row)
        ints[at.LATEST] = ints[at.CHANGED] = ints[at.SEEN] = now
        ints[at.TIMED] = 1
    if elapsed > 0 and not word & REJECTED_SPIKE:
        ints[at.LATEST] = now
        failed = word & REJECTED_STEP != 0
        if has_diverged(levels, ints, reals, eps[row, 0], failed, now):
            refresh(ints, reals, levels, memory)
            levels[HAT, 0] = memory[Y] = y
            ints[at.DIVERGENCES] += 1
            word = word & (FLAGS ^ REJECTED_STEP) | DIVERGED
            word |= innovations(scalars, levels, y, eps, row) << LEVEL_SHIFT
    if not word & REJECTED:
        ints[at.ACCEPTED] += 1
        ints[at.VALID] = 1
        ints[at.STAMP] = stamp if ints[at.NOMINAL] else now
    elif word & REJECTED_STEP:
        ints[at.REJECTED_STEPS] += 1
    else:
        last = memory[Y] if memory[Y] == memory[Y] else levels[HAT, 0]
        word |= innovations(scalars, levels, last, eps, row) << LEVEL_SHIFT
    return word


@njit(cache=True, error_model='numpy')
def take_once(
    stamp: int, y: float, u: float, eps: Floats, ints: Ints, reals: Floats,
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, levels: Floats, memory: Floats,
) -> int:  # fmt: skip
    """Take one sample, see `take`. The innovations go to eps[0]."""
    flags, gains, curves, scalars = (
        borrowed(flags), borrowed(gains), borrowed(curves), borrowed(scalars)
    )  # fmt: skip
    tape, offsets = borrowed(tape), borrowed(offsets)
    x, m, stack = borrowed(x), borrowed(m), borrowed(stack)
    levels, memory, eps = borrowed(levels), borrowed(memory), borrowed(eps)
    ints, reals = borrowed(ints), borrowed(reals)
    return take(
        stamp, y, u, eps, 0, ints, reals,
        flags, gains, curves, scalars, tape, offsets, x, m, stack, levels, memory,
    )  # fmt: skip


@njit(cache=True, error_model='numpy')
def run(
    stamps: Ints, y: Floats, u: Floats,
    out: Floats, gamma: Floats, words: Ints, eps: Floats, ints: Ints, reals: Floats,
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, levels: Floats, memory: Floats,
) -> None:  # fmt: skip
    """Take K samples; row k of `out` (K, 2, N), `gamma`, `words` and `eps` is after the k-th."""
    flags, gains, curves, scalars = (
        borrowed(flags), borrowed(gains), borrowed(curves), borrowed(scalars)
    )  # fmt: skip
    tape, offsets = borrowed(tape), borrowed(offsets)
    x, m, stack = borrowed(x), borrowed(m), borrowed(stack)
    levels, memory, eps = borrowed(levels), borrowed(memory), borrowed(eps)
    ints, reals = borrowed(ints), borrowed(reals)
    for k in range(y.shape[0]):
        words[k] = take(
            stamps[k], y[k], u[k], eps, k, ints, reals,
            flags, gains, curves, scalars, tape, offsets, x, m, stack, levels, memory,
        )  # fmt: skip
        for i in range(levels.shape[1]):
            out[k, HAT, i] = levels[HAT, i]
            out[k, TILDE, i] = levels[TILDE, i]
        gamma[k] = memory[GAMMA]
