# SPDX-License-Identifier: Apache-2.0
"""The time of a sample by a clock that stands still between its ticks, in nanoseconds."""

# Stands for every difference (ns) that an integer may not hold.
cdef long long FAR = 4_000_000_000_000_000_000
# A tick belongs to the line through those before it if it is off by at most so many intervals of
# the samples, and so many times as far as they usually are.
cdef long long FOLLOWED = 2, UNUSUAL = 4
# Samples whose ticks are off by more than so many intervals on average are not steady: for so many
# ticks there is no line.
cdef double STEADY = 2.0
cdef long long AGAIN = 5000
# For so long (ns) a line that remembers so many ticks goes on without one that belongs to it: when
# the node has not run for a moment, ticks and samples come at once, in any order.
cdef long long PATIENCE = 200_000_000, KNOWN = 16
# Samples that the line remembers; those in which times follow it, at most, and a part of those
# that it remembers so far.
cdef long long MOST_SAMPLES = 51_200
cdef double SMOOTH = 4000.0, YOUNG = 4.0
# Parts of a nanosecond in which the interval of the samples between ticks is kept.
cdef long long FINE = 1024


cdef long long difference(long long a, long long b) noexcept nogil:
    """Return a - b, or +-FAR where that would overflow."""
    cdef double rough = <double>a - <double>b
    if rough > FAR:
        return FAR
    return -FAR if rough < -FAR else a - b


cdef long long floored(long long a, long long b) noexcept nogil:
    """Return the largest integer of at most a / b, for b > 0."""
    return a // b - (a % b < 0)


cdef long long clock_time(
    Clock* clock, long long stamp, long long max_gap, long long* spread
) noexcept nogil:
    """
    Return the time of a sample that came when the clock read `stamp`.

    A straight line is fitted to the ticks by least squares with a growing memory (an alpha-beta
    filter), and times follow it smoothly: a tick, or a sample, that comes late moves them by
    little. While there is no line they are spread, and end short of the next tick that is
    expected. `spread` counts samples that are put after a reading.
    """
    cdef double spacing = <double>clock.spacing / FINE
    cdef long long count = clock.tick_count, length = difference(stamp, clock.tick)
    cdef long long expected = clock.phase + <long long>(count * spacing), end, shift
    if stamp == clock.tick:
        clock.tick_count += 1
        end = stamp + clock.tick_length
        if clock.ticks <= 0:
            shift = min(<long long>spacing, floored(end - clock.placed, 2))
        else:
            shift, end = follow(clock, expected), end + limit(clock) + patience(clock)
            if expected > end:  # the clock stands for longer than expected
                shift = min(shift, floored(end - clock.placed, 2))
        if shift > 0:
            clock.placed += shift
            spread[0] += 1
        return clock.placed
    clock.tick, clock.tick_count = stamp, 1
    if count > 0 and 0 < length <= max_gap:
        clock.tick_length = length
        take_tick(clock, count, expected)
    else:
        clock.ticks, clock.placed, clock.fitted = 0, stamp, stamp
    return clock.placed


cdef void take_tick(Clock* clock, long long count, long long expected) noexcept nogil:
    """Take a tick after `count` samples at the one before; put its first sample."""
    cdef double spacing = <double>clock.spacing / FINE
    cdef long long error = difference(clock.tick, expected), n = clock.ticks
    if n > 0 and abs(error) <= limit(clock):
        clock.fitted = clock.tick
        clock.ticks = n = min(n + 1, 1 + MOST_SAMPLES // count)
        clock.phase = expected + <long long>(<double>(4 * n - 2) / (n * (n + 1)) * error)
        clock.spacing += <long long>(FINE * 6.0 / (n * (n + 1)) * error / count)
        clock.deviation += floored(abs(error) - clock.deviation, min(n, WINDOW))
        clock.placed += follow(clock, clock.phase)
        if n > WINDOW and clock.deviation > STEADY * spacing:
            clock.ticks = -AGAIN
        return
    if difference(clock.tick, clock.fitted) <= patience(clock):
        clock.phase = expected
        clock.placed += follow(clock, expected)
        return
    if n >= KNOWN:  # a gap: the samples come as before, but later
        clock.ticks = KNOWN - 1
    else:  # a line goes through this tick and the one before, if samples had the same reading
        clock.ticks = n + 1 if n < 0 else 2 if count > 1 else 0
        clock.spacing = FINE * clock.tick_length // count
    clock.pace, clock.deviation, clock.fitted = clock.spacing, 0, clock.tick
    # A tick that came early finds samples ahead of it: time goes on at half its speed.
    clock.phase = max(clock.tick, clock.placed + floored(clock.spacing, 2 * FINE))
    clock.placed = clock.phase


cdef long long limit(const Clock* clock) noexcept nogil:
    """Return how far (ns) a tick may be off the line through those before it."""
    return <long long>(FOLLOWED * <double>clock.spacing / FINE + UNUSUAL * clock.deviation)


cdef long long patience(const Clock* clock) noexcept nogil:
    """Return how long (ns) the line goes on although no tick is on it."""
    return PATIENCE if clock.ticks >= KNOWN else 0


cdef long long follow(Clock* clock, long long on_line) noexcept nogil:
    """Return the next interval of the times that follow the line: critically damped, forward."""
    cdef double spacing = <double>clock.spacing / FINE, pace = <double>clock.pace / FINE
    cdef double remembered = <double>(clock.ticks * clock.tick_length) / spacing
    cdef double time = min(SMOOTH, 1.0 + remembered / YOUNG)
    cdef double behind = on_line - clock.placed - pace
    clock.pace += <long long>(FINE * behind / (time * time))
    return <long long>max(pace + 2.0 * behind / time, spacing / 2.0)
