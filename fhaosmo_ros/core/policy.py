# SPDX-License-Identifier: Apache-2.0
"""
The policy of time and of bad data, compiled: one function for node, replay and channels.

What it does, case by case, is in docs/operation.md; the arrays are described in policy_layout.py.
"""

from fhaosmo_ros.core import policy_layout as at
from fhaosmo_ros.core.borrowed import borrowed
from fhaosmo_ros.core.kernels import innovations, start, step
from fhaosmo_ros.core.layout import GAMMA, HAT, TILDE, Y
from fhaosmo_ros.core.policy_data import has_diverged, is_spike, is_stuck
from fhaosmo_ros.core.policy_time import (
    clock_time,
    difference,
    ENOUGH,
    forget,
    refresh,
    restore,
    save,
    settle,
    update_mean,
)
from fhaosmo_ros.core.prediction import advance, ahead, estimates
from fhaosmo_ros.core.status import LEVEL_SHIFT, REJECTED, Status
from fhaosmo_ros.core.tape import Floats, Ints
from numba import njit
import numpy as np

REJECTED_MEASUREMENT = int(Status.REJECTED_MEASUREMENT)
REJECTED_PERIOD = int(Status.REJECTED_PERIOD)
REJECTED_STEP = int(Status.REJECTED_STEP)
REJECTED_SPIKE = int(Status.REJECTED_SPIKE)
REJECTED_STUCK = int(Status.REJECTED_STUCK)
GAP = int(Status.GAP)
DIVERGED = int(Status.DIVERGED)
FLAGS = (1 << LEVEL_SHIFT) - 1

NANOSECONDS = 1e-9
GAP_RATIO = 2.0
"""With max_step = 0 an interval of more mean intervals than this is a gap."""
MOST_SUB_STEPS = 10_000
"""Bounds what one sample may cost: a few milliseconds."""


@njit(cache=True, error_model='numpy', forceinline=True)
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
    elif ints[at.CLOCK] and stamp != 0:
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
        if has_diverged(scalars, levels, ints, reals, eps[row, 0], failed, now):
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
        word |= innovations(scalars, levels, memory[Y], eps, row) << LEVEL_SHIFT
    return word


@njit(cache=True, error_model='numpy', forceinline=True)
def step_over(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, levels: Floats, memory: Floats, eps: Floats,
    ints: Ints, reals: Floats, elapsed: int, y: float, u: float, row: int,
) -> int:  # fmt: skip
    """
    Step to a sample `elapsed` later, through a gap in sub-steps; return the status word.

    In a gap the observer sees y as the model continues it from the last sample and the internal
    estimates, plus a straight line that ends in the new sample.
    """
    count = 1
    if ints[at.MAX_STEP]:
        if elapsed > ints[at.MAX_STEP]:
            count = min(-(-elapsed // ints[at.MAX_STEP]), MOST_SUB_STEPS)
    elif ints[at.INTERVALS] >= ENOUGH and elapsed > GAP_RATIO * reals[at.INTERVAL]:
        count = int(min(elapsed / reals[at.INTERVAL] + 0.5, MOST_SUB_STEPS))
    h = elapsed * NANOSECONDS / count
    gamma, word, bend, modelled, z = memory[GAMMA], 0, 0.0, True, x[0]
    if count > 1 or reals[at.GATE] > 0.0:
        z = np.empty(offsets.shape[0] - 1)
        end = ahead(tape, offsets, m, stack, levels, memory, z, h, u, count)
        modelled = abs(end) <= reals[at.LIMIT]  # False for NaN
        if not modelled:
            end = memory[Y]
        if reals[at.GATE] > 0.0 and is_spike(ints, reals, y - end):
            return REJECTED_SPIKE
        bend = (y - end) / count
        estimates(levels, memory, z)
    ints[at.BRIDGED] = 0
    if count > 1:
        save(reals, levels, memory)
        ints[at.BRIDGED] = 1
        ints[at.BEFORE] = ints[at.LATEST]
        ints[at.GAPS] += 1
        ints[at.SUB_STEPS] += count
        word = GAP
    for k in range(1, count + 1):
        sample = y
        if k < count:
            if modelled:
                advance(tape, offsets, m, stack, z, h, u)
            sample = z[0] + k * bend
        word = word & FLAGS | step(
            flags, gains, curves, scalars, tape, offsets, x, m, stack,
            levels, memory, sample, h, u, eps, row,
        )  # fmt: skip
        if ints[at.FROZEN]:
            memory[GAMMA] = gamma
        if word & REJECTED:
            break
    if not word & REJECTED:
        update_mean(ints, reals, elapsed)
    elif count > 1:
        restore(reals, levels, memory)
        memory[Y] = y  # as where a single step fails
        word = word & FLAGS | innovations(scalars, levels, y, eps, row) << LEVEL_SHIFT
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
