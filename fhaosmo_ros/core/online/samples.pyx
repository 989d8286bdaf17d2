# SPDX-License-Identifier: Apache-2.0
"""
What a sample tells by itself, before the observer sees it: its time, and whether y can be true.

Times are those of stamps, or of a clock that stands still between its ticks. Values of y may say
something of its sensor, and nothing of the plant.
"""

from libc.math cimport fabs, fmax, fmin, rint

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
# A step of y is a multiple of another one up to this, and up to rounding of y to 32 bits.
cdef double MULTIPLE = 1e-4, SINGLE = 6e-7
# After so many regular changes y's sensor holds its values; so many are remembered.
cdef int ENOUGH_REGULAR = 4, MOST_REGULAR = 12
# A y with noise may repeat itself so often in a row by chance, if it is a float of 32 bits.
cdef int CHANCE_REPEATS = 2
# Of late, less than this share of so many of its values were repeated, but for one: at the end of
# a range it is always the same one.
cdef double RARELY = 0.05, CHANGES = 50.0
# So many samples in a row may be rejected by spike_gate.
cdef int MOST_SPIKES = 5


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
    Clock* clock, long long stamp, long long max_gap, Counters* counters
) noexcept nogil:
    """
    Return the time of a sample that came when the clock read `stamp`.

    A clock that stands still between its ticks gives many samples one reading. A straight line is
    fitted to the ticks by least squares with a growing memory (an alpha-beta filter), and times
    follow it smoothly: a tick, or a sample, that comes late moves them by little, and a node that
    stands for a moment does not move them. While there is no such line they are spread, and end
    short of the next tick that is expected.
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
            counters.spread_stamps += 1
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


cdef bint is_stuck(
    Sensor* sensor, const Settings* settings, Counters* counters, double last, double y,
    long long now, long long max_gap
) noexcept nogil:
    """Return True, and count it, if y has been seen unchanged for longer than stuck_time."""
    cdef long long silence = abs(difference(now, sensor.seen))
    sensor.seen = now
    if y != last or silence > max_gap:
        sensor.changed, sensor.stuck = now, False
        return False
    if difference(now, sensor.changed) <= settings.stuck_time:
        return False
    if not sensor.stuck:
        sensor.stuck = True
        counters.stuck += 1
    counters.rejected_stuck += 1
    return True


cdef bint is_held(
    Sensor* sensor, long long max_gap, const Course* course, double y, long long now
) noexcept nogil:
    """
    Return True if y repeats a value because its sensor holds it, being slower than the topic.

    Only for self-tuning, which would take every change after it for one of d. A sensor holds
    values if they change after as many samples as before, about, and not by multiples, as an
    encoder's counts do. y may also really stand still: then it repeats itself for longer. What is
    counted here serves `repeats_noise`, too.
    """
    cdef long long elapsed = difference(now, course.latest), usual = sensor.held_for
    cdef double before = sensor.sample, change = y - before, low, high, others, elsewhere
    if course.timed and elapsed <= 0:
        return False  # a sample that comes twice is no repetition
    sensor.sample = y
    if change == 0.0:
        sensor.repeats += 1
        if sensor.repeats > 2 * usual + 1 or 2 * abs(elapsed) >= max_gap:
            return False
        return sensor.holds
    low, high = fmin(fabs(change), fabs(sensor.change)), fmax(fabs(change), fabs(sensor.change))
    others = high / low if low > 0.0 else 0.0
    sensor.stuck, elsewhere = False, 0.0
    if sensor.repeats > 0 and before != sensor.repeated:
        elsewhere, sensor.repeated = 1.0, before
    sensor.elsewhere += (elsewhere - sensor.elsewhere) / CHANGES
    if sensor.repeats == 0 or 4 * abs(sensor.repeats - usual) > max(usual, 4):
        sensor.regular = max(sensor.regular - 2, 0)
    elif low > 0.0 and fabs(others - rint(others)) > MULTIPLE + SINGLE * fabs(y) / low:
        sensor.regular = min(sensor.regular + 1, MOST_REGULAR)
    if sensor.regular == 0:
        sensor.held_for, sensor.holds = sensor.repeats, False
    elif sensor.regular >= ENOUGH_REGULAR:
        sensor.holds = True
    sensor.repeats, sensor.change = 0, change
    return False


cdef bint may_have_noise(const Sensor* sensor) noexcept nogil:
    """Return True if a y with noise would be stuck from this sample on; after `is_held`."""
    return (
        sensor.repeats == CHANCE_REPEATS + 1 and not sensor.stuck and sensor.elsewhere < RARELY
    )


cdef bint repeats_noise(Sensor* sensor, Counters* counters, double y, bint noisy) noexcept nogil:
    """
    Return True, and count it, if y repeats itself although it has noise; after `is_held`.

    The sensor is stuck then, or at the end of its range: that y stands still is no motion. Only
    for self-tuning, which knows whether y has noise, and is not quantised.

    Parameters
    ----------
    noisy : bool
        `may_have_noise`, and it has.

    """
    if sensor.repeats <= CHANCE_REPEATS or y != sensor.sample:
        return False  # also of another y whose stamp is not later: `is_held` leaves that alone
    if noisy:
        sensor.stuck = True
        counters.stuck += 1
    counters.rejected_stuck += sensor.stuck
    return sensor.stuck


cdef bint is_spike(
    Course* course, const Settings* settings, Counters* counters, double innovation
) noexcept nogil:
    """Return True, and count it, if y is too far from its prediction to be believed yet."""
    if fabs(innovation) <= settings.gate:
        course.spikes = 0
        return False
    course.spikes += 1
    if course.spikes > MOST_SPIKES:
        course.spikes = 0
        counters.spikes_believed += 1
        return False
    counters.rejected_spikes += 1
    return True
