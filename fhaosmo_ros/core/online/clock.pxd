# SPDX-License-Identifier: Apache-2.0
"""Times by a clock that stands still between its ticks."""

cdef long long FAR


cdef struct Clock:
    # A line through the ticks of a clock that stands still between them.
    long long tick  # latest reading
    long long tick_length  # time from the reading before it
    long long tick_count  # samples at it
    long long ticks  # that the line remembers; 0: no line
    long long placed  # where the latest sample was put
    double on_line  # where the line has it (ns after `tick`)
    double spacing  # of samples, by the line (ns)


cdef long long difference(long long a, long long b) noexcept nogil
cdef long long clock_time(
    Clock* clock, long long stamp, long long max_gap, long long* spread
) noexcept nogil
