# SPDX-License-Identifier: Apache-2.0
"""Times of samples by a clock that stands still between its ticks."""

from fhaosmo_ros.core.online.memory cimport Clock, Counters

cdef long long FAR

cdef enum:
    WINDOW = 32  # intervals, or ticks, that a running mean remembers


cdef long long difference(long long a, long long b) noexcept nogil
cdef long long clock_time(
    Clock* clock, long long stamp, long long max_gap, Counters* counters
) noexcept nogil
