# SPDX-License-Identifier: Apache-2.0
"""The policy's rules for stamps (see policy.py), each a small compiled function."""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats, Ints
from fhaosmo_ros.core.observer.arrays import GAMMA, State
from fhaosmo_ros.core.observer.status import HELD, REJECTED_PERIOD, RESTARTED
from fhaosmo_ros.core.observer.step import start
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.delay import forget_past
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy

WINDOW = 32
"""Intervals that a running mean remembers; before it has so many, none is called long or short."""
FOLLOWED, UNUSUAL = 2, 4
"""
A tick belongs to the line through those before it if it is off by at most so many intervals of the
samples, and so many times as far as they usually are.
"""
PATIENCE, KNOWN = 200_000_000, 16
"""
For so long (ns) a line that remembers so many ticks goes on without one that belongs to it: when
the node has not run for a moment, ticks and samples come at once, in any order.
"""
MOST_SAMPLES, SMOOTH, YOUNG = 51_200, 4000.0, 4.0
"""
Samples that the line remembers; those in which times follow it, at most, and a part of those that
it remembers so far.
"""
FINE = 1024
"""Parts of a nanosecond in which the interval of the samples between ticks is kept."""
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
def clock_time(ints: Ints, stamp: int) -> int:
    """
    Return the time of a sample that came when the clock read `stamp`.

    A clock that stands still between its ticks gives many samples one reading. A straight line is
    fitted to the ticks by least squares with a growing memory (an alpha-beta filter), and times
    follow it smoothly: a tick, or a sample, that comes late moves them by little, and a node that
    stands for a moment does not move them. While there is no such line they are spread, and end
    short of the next tick that is expected.
    """
    spacing, placed = ints[at.SPACING] / FINE, ints[at.PLACED]
    if stamp == ints[at.TICK]:
        on_line = ints[at.PHASE] + int(ints[at.TICK_COUNT] * spacing)
        ints[at.TICK_COUNT] += 1
        end = stamp + ints[at.TICK_LENGTH]
        if not ints[at.TICKS]:
            shift = min(int(spacing), (end - placed) // 2)
        else:
            shift, end = follow(ints, on_line), end + limit(ints) + patience(ints)
            if on_line > end:  # the clock stands for longer than expected
                shift = min(shift, (end - placed) // 2)
        if shift > 0:
            ints[at.PLACED] += shift
            ints[at.SPREAD_STAMPS] += 1
        return int(ints[at.PLACED])
    length, count = difference(stamp, ints[at.TICK]), ints[at.TICK_COUNT]
    ints[at.TICK] = stamp
    ints[at.TICK_COUNT] = 1
    if not (count and 0 < length <= ints[at.MAX_GAP]):
        ints[at.TICKS] = 0
        ints[at.PLACED] = stamp
        return stamp
    ints[at.TICK_LENGTH] = length
    expected = ints[at.PHASE] + int(count * spacing)
    error = difference(stamp, expected)
    if ints[at.TICKS] and abs(error) <= limit(ints):
        ints[at.FITTED] = stamp
        ints[at.TICKS] = n = min(ints[at.TICKS] + 1, 1 + MOST_SAMPLES // count)
        ints[at.PHASE] = expected + int((4 * n - 2) / (n * (n + 1)) * error)
        ints[at.SPACING] += int(FINE * 6.0 / (n * (n + 1)) * error / count)
        ints[at.DEVIATION] += (abs(error) - ints[at.DEVIATION]) // min(n, WINDOW)
        ints[at.PLACED] += follow(ints, ints[at.PHASE])
        return int(ints[at.PLACED])
    if difference(stamp, ints[at.FITTED]) <= patience(ints):
        ints[at.PHASE] = expected
        ints[at.PLACED] += follow(ints, expected)
        return int(ints[at.PLACED])
    if ints[at.TICKS] >= KNOWN:  # a gap: the samples come as before, but later
        ints[at.TICKS] = KNOWN - 1
    else:  # a line goes through this tick and the one before, if samples had the same reading
        ints[at.TICKS] = 2 if count > 1 else 0
        ints[at.SPACING] = FINE * length // count
    ints[at.PACE] = ints[at.SPACING]
    ints[at.DEVIATION], ints[at.FITTED] = 0, stamp
    # A tick that came early finds samples ahead of it: time goes on at half its speed.
    ints[at.PLACED] = ints[at.PHASE] = max(stamp, placed + ints[at.SPACING] // (2 * FINE))
    return int(ints[at.PLACED])


@compiled()
def limit(ints: Ints) -> int:
    """Return how far (ns) a tick may be off the line through those before it."""
    return int(FOLLOWED * ints[at.SPACING] / FINE + UNUSUAL * ints[at.DEVIATION])


@compiled()
def patience(ints: Ints) -> int:
    """Return how long (ns) the line goes on although no tick is on it."""
    return PATIENCE if ints[at.TICKS] >= KNOWN else 0


@compiled()
def follow(ints: Ints, on_line: int) -> int:
    """Return the next interval of the times that follow the line: critically damped, forward."""
    spacing, pace = ints[at.SPACING] / FINE, ints[at.PACE] / FINE
    remembered = ints[at.TICKS] * ints[at.TICK_LENGTH] / spacing
    time = min(SMOOTH, 1.0 + remembered / YOUNG)
    behind = on_line - ints[at.PLACED] - pace
    ints[at.PACE] += int(FINE * behind / time**2)
    return int(max(pace + 2.0 * behind / time, spacing / 2.0))


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
