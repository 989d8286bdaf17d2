# SPDX-License-Identifier: Apache-2.0
"""Rules for values of y that say something of its sensor, or nothing of the plant."""

from libc.math cimport fabs, fmax, fmin, rint

from fhaosmo_ros.core.online.clock cimport difference
from fhaosmo_ros.core.online.memory cimport Counters, Course, Sensor, Settings

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
