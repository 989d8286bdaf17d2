# SPDX-License-Identifier: Apache-2.0
"""Times by a clock that stands still between its ticks."""

cdef long long FAR

cdef enum:
    WINDOW = 32  # intervals, or ticks, that a running mean remembers


cdef struct Clock:
    # A line through the ticks of a clock that stands still between them.
    long long tick  # latest reading
    long long tick_length  # time from the reading before it
    long long tick_count  # samples at it
    long long spacing  # of samples at one reading (ns / FINE); 0: not known yet
    long long placed  # where the latest sample was put
    long long phase  # time of the first sample at that reading
    long long ticks  # that the line remembers; 0: no line; < 0: none for so many ticks
    long long deviation  # running mean of how far ticks are off it
    long long pace  # interval of the times that follow the line (ns / FINE)
    long long fitted  # latest tick that was on the line


cdef long long difference(long long a, long long b) noexcept nogil
cdef long long clock_time(
    Clock* clock, long long stamp, long long max_gap, long long* spread
) noexcept nogil
