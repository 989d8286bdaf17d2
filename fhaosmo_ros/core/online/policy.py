# SPDX-License-Identifier: Apache-2.0
"""
The policy of time and of bad data, compiled: one function for node, replay and trials.

What it does, case by case, is in docs/operation.md; the arrays are described in memory.py.
"""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import unowned
from fhaosmo_ros.core.model.bytecode import Bytecode, Floats, Ints
from fhaosmo_ros.core.observer.arrays import (
    HAT,
    Law,
    OFFSET,
    State,
    Work,
    Y,
)
from fhaosmo_ros.core.observer.status import (
    DIVERGED,
    FLAGS_MASK,
    JUMPED,
    LEVEL_SHIFT,
    REJECTED,
    REJECTED_MEASUREMENT,
    REJECTED_PERIOD,
    REJECTED_SPIKE,
    REJECTED_STEP,
    REJECTED_STUCK,
    REPEATED,
    RESTARTED,
    UNUSED,
)
from fhaosmo_ros.core.observer.step import innovations, Record, record_state, start
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.clock import clock_time
from fhaosmo_ros.core.online.delay import (
    forget_past,
    INPUTS,
    inputs_before,
    keep_latest,
    note_inputs,
    past_of,
    published,
    withdraw_inputs,
)
from fhaosmo_ros.core.online.gaps import step_over
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy
from fhaosmo_ros.core.online.outliers import has_diverged, is_held, is_stuck, repeats_noise
from fhaosmo_ros.core.online.stamps import difference, forget, refresh, settle


@compiled(inline='always')
def take(e: EstimatorArrays, stamp: int, y: float, u: Floats, eps: Floats, row: int) -> int:
    """
    Take one sample.

    Parameters
    ----------
    e : EstimatorArrays
    stamp : int
        Nanoseconds.
    y : float
        Sample, any number.
    u : (m,) array
        Known inputs, finite.
    eps : (rows, N) array
        Row `row` gets the innovations.

    Returns
    -------
    int
        Status word, see status.py.

    """
    law, _, state, policy = e
    ints, reals, levels, memory = policy.ints, policy.reals, state.levels, state.memory
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
    elif ints[at.STUCK_TIME] and is_stuck(policy, memory[Y], y - memory[OFFSET], now):
        word = REJECTED_STUCK
    elif is_held(e, y, now):
        word = REPEATED
    elif repeats_noise(e, y):
        word = REJECTED_STUCK
    elif memory[Y] == memory[Y]:
        if not ints[at.TIMED]:
            forget(policy, now)
        elapsed = difference(now, ints[at.LATEST])
        if 0 < elapsed <= ints[at.MAX_GAP]:
            ints[at.HELD] = 0
        else:
            latest = ints[at.LATEST]
            elapsed, word = settle(e, now, elapsed, y, eps, row)
            if word & RESTARTED:
                forget_past(policy, state)
            elif elapsed > 0 and ints[at.LAG] > 0:  # a gap was withdrawn
                withdraw_inputs(past_of(policy, state), latest - ints[at.LATEST], u.shape[0])
    if elapsed > 0 and ints[at.LAG] > 0:
        past = past_of(policy, state)
        note_inputs(past, elapsed, u)
        acting = inputs_before(past, ints[at.LAG], elapsed, u)
        word |= step_over(e, elapsed, y, acting, eps, row)
        if word & REJECTED_SPIKE:
            withdraw_inputs(past, elapsed, u.shape[0])
    elif elapsed > 0:
        word |= step_over(e, elapsed, y, u, eps, row)
    elif not word & UNUSED:  # first sample, or first after a restart
        word |= start(law, state, y, eps, row)
        ints[at.LATEST] = ints[at.CHANGED] = ints[at.SEEN] = now
        ints[at.TIMED] = 1
    if elapsed > 0 and not word & REJECTED_SPIKE:
        ints[at.LATEST] = now
        failed = word & REJECTED_STEP != 0
        if word & DIVERGED:
            ints[at.DIVERGENCES] += 1
            ints[at.LOST] = 0
        elif has_diverged(e, eps[row, 0], failed, now):
            refresh(policy, state)
            levels[HAT, 0] = memory[Y] = y
            ints[at.DIVERGENCES] += 1
            word = word & (FLAGS_MASK ^ REJECTED_STEP) | DIVERGED
            word |= innovations(law, state, y, eps, row) << LEVEL_SHIFT
    if word & REPEATED:  # the estimate stays that of the sample which it repeats
        ints[at.ACCEPTED] += 1
        word |= innovations(law, state, memory[Y], eps, row) << LEVEL_SHIFT
    elif not word & REJECTED:
        ints[at.ACCEPTED] += 1
        ints[at.VALID] = 1
        if ints[at.DELAY] > 0:
            keep_latest(policy, state, u)
        ints[at.STAMP] = stamp if ints[at.NOMINAL] else now
    elif word & REJECTED_STEP:
        ints[at.REJECTED_STEPS] += 1
    else:
        if word & JUMPED:  # z_1 has followed y, and only the next sample gives it a time
            ints[at.VALID] = 0
        last = memory[Y] if memory[Y] == memory[Y] else levels[HAT, 0]
        word |= innovations(law, state, last, eps, row) << LEVEL_SHIFT
    return word


@compiled()
def take_once(
    stamp: int,
    y: float,
    u: Floats,
    eps: Floats,
    ints: Ints,
    reals: Floats,
    flags: Ints,
    gains: Floats,
    curves: Floats,
    scalars: Floats,
    chances: Floats,
    code: Floats,
    offsets: Ints,
    x: Floats,
    stack: Floats,
    stages: Floats,
    levels: Floats,
    memory: Floats,
) -> int:
    """
    Take one sample, see `take`. The innovations go to eps[0].

    Takes the contents of the bundles, because Python calls it for every sample: handing over a
    named tuple costs some 3 microseconds a call.
    """
    law = Law(flags, gains, curves, scalars, chances, Bytecode(code, offsets))
    work, state, policy = Work(x, stack, stages), State(levels, memory), Policy(ints, reals)
    e = unowned(EstimatorArrays(law, work, state, policy))
    return take(e, stamp, y, unowned(u), unowned(eps), 0)


@compiled()
def run(
    e: EstimatorArrays,
    stamps: Ints,
    y: Floats,
    u: Floats,
    record: Record,
    present: Floats,
    times: Ints,
    acting: Floats,
) -> None:
    """
    Take K samples; row k of the record is the estimate after the k-th.

    Parameters
    ----------
    present : (K, n + 1) or (0, n + 1) array
        Gets z and d as they are published, if there is room for them.
    times, acting : (K,), (K, m) or (0,), (0, m) arrays
        Get the time of the observer after each, and the inputs that acted until then.

    """
    e, u, eps = unowned(e), unowned(u), unowned(record.eps)
    for k in range(y.shape[0]):
        record.words[k] = take(e, stamps[k], y[k], u[k], eps, k)
        record_state(e.law, e.state, record, k)
        if present.shape[0] > 0:
            published(e, e.policy.ints[at.FILTERED], present[k])
        if times.shape[0] > 0:
            times[k] = e.policy.ints[at.LATEST]
            delayed = e.policy.ints[at.LAG] > 0
            past = past_of(e.policy, e.state)
            for j in range(u.shape[1]):
                acting[k, j] = past[INPUTS + j] if delayed else u[k, j]
