# SPDX-License-Identifier: Apache-2.0
"""The policy's rules for stamps (see policy.py), each a small compiled function."""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import GAMMA, State
from fhaosmo_ros.core.observer.status import HELD, REJECTED_PERIOD, RESTARTED
from fhaosmo_ros.core.observer.step import start
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.delay import forget_past
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy

WINDOW = 32
"""Intervals that a running mean remembers; before it has so many, none is called long or short."""
FAR = 4 * 10**18
"""Stands for every difference (ns) that an integer may not hold."""


@compiled(forceinline=True)
def difference(a: int, b: int) -> int:
    """Return a - b, or +-FAR where that would overflow."""
    rough = float(a) - float(b)
    if abs(rough) > FAR:
        return FAR if rough > 0.0 else -FAR
    return a - b


@compiled()
def settle(
    e: EstimatorArrays, now: int, elapsed: int, y: float, eps: Floats, row: int
) -> tuple[int, int]:
    """
    Decide about a sample that does not follow the one before it within max_gap.

    Returns
    -------
    (int, int)
        Time to step over, and flags. Where the time is 0 and no flag rejects, the observer is
        fresh and the sample is its first.

    """
    (law, _, state, policy), ints, reals = e, e.policy.ints, e.policy.reals
    if ints[at.NOMINAL]:
        if 0 < elapsed <= ints[at.PERIOD]:
            return elapsed, 0  # nothing was lost: the period itself is longer than max_gap
        ints[at.RESTARTS_FORWARD] += 1
        refresh(policy, state)
        return 0, RESTARTED
    if elapsed == 0 or (ints[at.HELD] and now == ints[at.HELD_STAMP]):
        ints[at.DUPLICATE_STAMPS] += 1
        return 0, REJECTED_PERIOD
    if -ints[at.MAX_GAP] <= elapsed < 0:
        if not (ints[at.BRIDGED] and now > ints[at.BEFORE]):
            ints[at.BACKWARD_STAMPS] += 1
            return 0, REJECTED_PERIOD
        restore(policy, state)  # the gap was none: its sample's stamp was ahead
        ints[at.LATEST] = ints[at.BEFORE]
        ints[at.BRIDGED] = 0
        ints[at.WITHDRAWN_GAPS] += 1
        ints[at.ACCEPTED] -= 1
        return difference(now, ints[at.BEFORE]), 0
    if not ints[at.HELD]:
        ints[at.HELD] = 1
        ints[at.HELD_STAMP] = now
        reals[at.HELD_Y] = y
        ints[at.FAR_STAMPS] += 1
        return 0, REJECTED_PERIOD | HELD
    ints[at.RESTARTS_FORWARD if elapsed > 0 else at.RESTARTS_BACKWARD] += 1
    refresh(policy, state)
    follow = difference(now, ints[at.HELD_STAMP])
    if not 0 < follow <= ints[at.MAX_GAP]:
        return 0, RESTARTED
    start(law, state, reals[at.HELD_Y], eps, row)
    ints[at.LATEST] = ints[at.CHANGED] = ints[at.HELD_STAMP]
    return follow, RESTARTED


@compiled()
def forget(policy: Policy, now: int) -> None:
    """Let the sample at `now`, of another clock, follow the one before by the usual interval."""
    ints, reals = policy.ints, policy.reals
    usual = int(reals[at.INTERVAL]) if ints[at.INTERVALS] else ints[at.PERIOD]
    ints[at.LATEST] = now - usual
    ints[at.CHANGED] = ints[at.SEEN] = now
    ints[at.HELD] = ints[at.BRIDGED] = ints[at.LOST] = 0
    ints[at.TIMED] = 1


@compiled(forceinline=True)
def update_mean(policy: Policy, elapsed: int) -> None:
    """Take an interval into the running means; a gap can't do more than double them."""
    ints, reals = policy.ints, policy.reals
    dt, mean = float(elapsed), reals[at.INTERVAL]
    if ints[at.INTERVALS] < WINDOW:
        ints[at.INTERVALS] += 1
    elif dt < 0.1 * mean:
        ints[at.BURSTS] += 1
    change = dt - mean
    if ints[at.INTERVALS] == WINDOW:
        change = min(change, WINDOW * mean)
    reals[at.INTERVAL] += change / ints[at.INTERVALS]
    if ints[at.INTERVALS] > 1:
        reals[at.JITTER] += (abs(change) - reals[at.JITTER]) / ints[at.INTERVALS]


@compiled()
def save(policy: Policy, state: State) -> None:
    """Remember the state before a gap."""
    k = at.STATES + state.levels.size + state.memory.size
    for value in state.levels.flat:
        policy.reals[k] = value
        k += 1
    for value in state.memory:
        policy.reals[k] = value
        k += 1


@compiled()
def restore(policy: Policy, state: State) -> None:
    """Go back to the state that was saved."""
    load(policy.reals, at.STATES + state.levels.size + state.memory.size, state)


@compiled()
def refresh(policy: Policy, state: State) -> None:
    """Make a fresh observer, whose next sample is the first; a frozen gamma stays."""
    ints, reals, gamma = policy.ints, policy.reals, state.memory[GAMMA]
    load(reals, at.STATES, state)
    if ints[at.FROZEN]:
        state.memory[GAMMA] = gamma
    ints[at.HELD] = ints[at.BRIDGED] = ints[at.SPIKES] = ints[at.LOST] = 0
    ints[at.INTERVALS] = 0
    reals[at.INTERVAL] = reals[at.JITTER] = 0.0


@compiled()
def forget_samples(policy: Policy, state: State) -> None:
    """Start afresh: the next sample is the first. Counters go on."""
    refresh(policy, state)
    forget_past(policy, state)
    policy.ints[at.VALID] = 0
    policy.ints[at.TICK_COUNT] = policy.ints[at.SPACING] = 0


@compiled()
def load(reals: Floats, k: int, state: State) -> None:
    """Read a state from index `k` of `reals` on."""
    for r in range(state.levels.shape[0]):
        for i in range(state.levels.shape[1]):
            state.levels[r, i] = reals[k]
            k += 1
    for i in range(state.memory.shape[0]):
        state.memory[i] = reals[k]
        k += 1
