# SPDX-License-Identifier: Apache-2.0
"""Times of samples by a clock that stands still between its ticks, each a compiled function."""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Ints
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.stamps import difference, WINDOW

FOLLOWED, UNUSUAL = 2, 4
"""
A tick belongs to the line through those before it if it is off by at most so many intervals of the
samples, and so many times as far as they usually are.
"""
STEADY, AGAIN = 2.0, 5000
"""
Samples whose ticks are off by more than so many intervals on average are not steady: for so many
ticks there is no line.
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
        if ints[at.TICKS] <= 0:
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
    if ints[at.TICKS] > 0 and abs(error) <= limit(ints):
        ints[at.FITTED] = stamp
        ints[at.TICKS] = n = min(ints[at.TICKS] + 1, 1 + MOST_SAMPLES // count)
        ints[at.PHASE] = expected + int((4 * n - 2) / (n * (n + 1)) * error)
        ints[at.SPACING] += int(FINE * 6.0 / (n * (n + 1)) * error / count)
        ints[at.DEVIATION] += (abs(error) - ints[at.DEVIATION]) // min(n, WINDOW)
        ints[at.PLACED] += follow(ints, ints[at.PHASE])
        if n > WINDOW and ints[at.DEVIATION] > STEADY * spacing:
            ints[at.TICKS] = -AGAIN
        return int(ints[at.PLACED])
    if difference(stamp, ints[at.FITTED]) <= patience(ints):
        ints[at.PHASE] = expected
        ints[at.PLACED] += follow(ints, expected)
        return int(ints[at.PLACED])
    if ints[at.TICKS] >= KNOWN:  # a gap: the samples come as before, but later
        ints[at.TICKS] = KNOWN - 1
    else:  # a line goes through this tick and the one before, if samples had the same reading
        ints[at.TICKS] = ints[at.TICKS] + 1 if ints[at.TICKS] < 0 else 2 if count > 1 else 0
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
