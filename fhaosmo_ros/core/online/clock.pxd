# SPDX-License-Identifier: Apache-2.0
"""Times by a clock that stands still between its ticks."""

cdef long long FAR


cdef struct Clock:
    # A line through the ticks of a clock that stands still between them.
    long long tick  # latest reading
    long long tick_length  # time from the reading before it
    long long tick_count  # samples at it
    long long ticks  # that the line remembers; 0: no line
    long long off_line  # latest ones in a row that were off it
    long long placed  # where the latest sample was put
    double on_line  # where the line has it (ns after `tick`)
    double spacing  # of samples, by the line (ns)


cdef enum:
    MOST_CORNERS = 16


cdef struct Corner:
    # Of the line below stamps, from the last sample of the latest burst.
    double samples  # back to this one: -1, ..; 0 for itself
    double time  # the same by their stamps (ns)


cdef struct Bursts:
    # What samples are like that come in bursts.
    bint in_bursts  # most do, and are placed on the line
    long long last_stamp
    double last_y
    long long ended  # the last stamp of the burst before
    long long begin  # when the first sample of the burst was taken
    int corners  # of the line below stamps
    double moved  # steps of y within the burst so far
    # Decaying sums: stamps from one burst to the next (ns), samples, and steps of y.
    double time_of_bursts, samples_of_bursts, within_bursts, between_bursts
    double share_of_bursts  # of late, of all that came; others are single samples, or off the line


cdef long long difference(long long a, long long b) noexcept nogil
cdef long long begin_of_burst(
    Bursts* bursts, const Clock* clock, Corner* corner, long long stamp, double y,
    long long max_gap
) noexcept nogil
cdef bint comes_in_bursts(const Bursts* bursts) noexcept nogil
cdef long long clock_time(
    Clock* clock, long long stamp, long long latest, long long max_gap, long long* spread
) noexcept nogil
