# SPDX-License-Identifier: Apache-2.0
"""Rules for values of y that say something of its sensor, or nothing of the plant."""

from fhaosmo_ros.core.online.memory cimport Counters, Course, Sensor, Settings

cdef bint is_stuck(
    Sensor* sensor, const Settings* settings, Counters* counters, double last, double y,
    long long now, long long max_gap
) noexcept nogil
cdef bint is_held(
    Sensor* sensor, long long max_gap, const Course* course, double y, long long now
) noexcept nogil
cdef bint may_have_noise(const Sensor* sensor) noexcept nogil
cdef bint repeats_noise(Sensor* sensor, Counters* counters, double y, bint noisy) noexcept nogil
cdef bint is_spike(
    Course* course, const Settings* settings, Counters* counters, double innovation
) noexcept nogil
