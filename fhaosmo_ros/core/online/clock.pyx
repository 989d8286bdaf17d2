# SPDX-License-Identifier: Apache-2.0
"""The time of a sample by a clock that ticks seldom, or by the bursts it came in (ns)."""

from libc.math cimport fabs, fmax, fmin, isfinite
from libc.string cimport memmove

# Stands for every difference (ns) that an integer may not hold.
cdef long long FAR = 4_000_000_000_000_000_000
# A tick that is off the line by more intervals of the samples than this does not correct it, but
# halves what it remembers: when the node has not run for a moment, ticks and samples come at once,
# in any order.
cdef double NEAR = 4.0
# Ticks that the line remembers at most; samples in which times follow it, and at least for each
# tick that it remembers: a kink of the times is one of the states.
cdef long long MOST_TICKS = 1024
cdef double SMOOTH = 50.0, EASY = 4.0
# Stamps closer than this part of the mean interval are those of a burst.
cdef double TOGETHER = 0.25
# Bursts that are remembered. Samples come in them if most of these are such, and a line goes
# through them, until few are; and if y moves from one to the next less than so many times as far
# as within them.
cdef long long MOST_VOTES = 4  # of the samples of a burst, in the share of bursts
cdef double REMEMBERED = 10.0, MOST = 0.75, FEW = 0.25, FARTHER = 2.0
# The line below stamps goes back over so many samples. In so many times REMEMBERED bursts one is
# stamped promptly.
cdef double BELOW = 2048.0, PROMPT = 8.0


cdef long long difference(long long a, long long b) noexcept nogil:
    """Return a - b, or +-FAR where that would overflow."""
    cdef double rough = <double>a - <double>b
    if rough > FAR:
        return FAR
    return -FAR if rough < -FAR else a - b


cdef double next_sample(
    Corner* corner, int* corners, double samples, double time, double recent
) noexcept nogil:
    """
    Return when after a stamp the next sample is taken, by the line below the stamps of late (ns).

    The stamp came so many `samples`, and so much `time`, after the one that was asked of before.
    No sample is stamped before it is taken. So of the lines below all stamps, which are those
    between corners of their lower convex hull, the one over their middle tells the period (Moon,
    Skelly and Towsley 1999, doi:10.1109/INFCOM.1999.749287), and the promptest of the `recent`
    samples when they are taken.
    """
    cdef int i, first = 0, count = corners[0]
    cdef double period, off, line = 0.0, below = 0.0, middle
    for i in range(count):
        corner[i].samples -= samples
        corner[i].time -= time
    while count > 1 and (
        (corner[count - 1].time - corner[count - 2].time) * corner[count - 2].samples
        <= corner[count - 2].time * (corner[count - 1].samples - corner[count - 2].samples)
    ):
        count -= 1
    if count == MOST_CORNERS or (count > 1 and corner[1].samples < -BELOW):
        count -= 1
        memmove(corner, corner + 1, count * sizeof(Corner))
    corner[count] = Corner(0.0, 0.0)
    corners[0] = count = count + 1
    if count == 1:
        return 0.0
    middle, i = 0.5 * corner[0].samples, 1
    while i < count - 1 and corner[i].samples < middle:
        i += 1
    period = (corner[i].time - corner[i - 1].time) / (corner[i].samples - corner[i - 1].samples)
    for i in range(count):
        off = corner[i].time - corner[i].samples * period
        below = fmin(below, off)
        if corner[i].samples < -recent:
            first = i + 1
        else:
            line = fmin(line, off)
    if line - below > NEAR * period:  # none was stamped promptly: samples have been lost
        corners[0] = count - first
        memmove(corner, corner + first, corners[0] * sizeof(Corner))
    return line + period


cdef long long begin_of_burst(
    Bursts* bursts, const Clock* clock, Corner* corner, long long stamp, double y,
    long long max_gap
) noexcept nogil:
    """
    Return when the first sample of a burst was taken, and follow what bursts are like.

    A driver that empties a buffer stamps samples as it reads them, when the last one has been
    taken, or later. The first one was taken a period after the last one of the burst before.
    """
    cdef double kept = 1.0 - 1.0 / REMEMBERED
    cdef double step = fabs(y - bursts.last_y)
    cdef long long length = difference(stamp, bursts.last_stamp), count = clock.tick_count
    cdef long long begin, passed
    cdef double due
    cdef bint on_line
    if not isfinite(step):
        step, y = 0.0, bursts.last_y
    if count == 0 or not 0 <= length <= max_gap:
        bursts.begin, bursts.ended = stamp, stamp - 1
        bursts.moved, bursts.corners = 0.0, 0
    elif length * bursts.samples_of_bursts < TOGETHER * bursts.time_of_bursts:
        bursts.moved += step
    else:
        passed = difference(bursts.last_stamp, bursts.ended)
        bursts.time_of_bursts = kept * bursts.time_of_bursts + passed
        bursts.samples_of_bursts = kept * bursts.samples_of_bursts + count
        on_line = clock.ticks > 2 and clock.off_line < 2 and (count > 1 or bursts.in_bursts)
        for _ in range(min(count, MOST_VOTES)):
            bursts.share_of_bursts *= kept
            bursts.share_of_bursts += (1.0 - kept) * on_line
        if count > 1:
            bursts.within_bursts = kept * bursts.within_bursts + bursts.moved / (count - 1)
            bursts.between_bursts = kept * bursts.between_bursts + step
        due = next_sample(
            corner, &bursts.corners, count, passed, PROMPT * bursts.samples_of_bursts
        )
        begin = difference(bursts.last_stamp, <long long>-fmax(fmin(due, FAR), -FAR))
        bursts.begin, bursts.ended = max(begin, bursts.begin + 1), bursts.last_stamp
        bursts.moved = 0.0
    bursts.last_stamp, bursts.last_y = stamp, y
    return bursts.begin


cdef bint comes_in_bursts(const Bursts* bursts) noexcept nogil:
    """Return True if samples come in bursts, and y moves as if it were sampled evenly."""
    if bursts.in_bursts:
        return bursts.share_of_bursts > FEW
    return bursts.share_of_bursts > MOST and (
        bursts.between_bursts < FARTHER * bursts.within_bursts
    )


cdef long long clock_time(
    Clock* clock, long long stamp, long long latest, long long max_gap, long long* spread
) noexcept nogil:
    """
    Return the time of a sample, `latest` at most, that came when the clock read `stamp`.

    A straight line is fitted to the ticks by least squares with a growing memory (an alpha-beta
    filter), and times follow it smoothly: a tick, or a sample, that comes late moves them by
    little. `spread` counts samples that are put after a reading.
    """
    cdef long long count = clock.tick_count, length = difference(stamp, clock.tick)
    cdef double ahead, step, most
    if count == 0 or not 0 <= length <= max_gap:
        clock.tick, clock.tick_count, clock.ticks = stamp, 1, 0
        clock.placed, clock.on_line = stamp, 0.0
        return stamp
    clock.tick_count += 1
    clock.on_line += clock.spacing
    if length > 0:
        clock.tick, clock.tick_length, clock.tick_count = stamp, length, 1
        clock.on_line -= length
        if not take_tick(clock, count):
            return clock.placed
    ahead = difference(clock.placed, stamp)
    step = (clock.on_line - ahead - clock.spacing) / max(SMOOTH, EASY * clock.ticks)
    step += clock.spacing
    most = difference(latest, clock.placed)
    if latest == FAR:  # it goes on for as many samples as it remembers ticks without the next one
        most = 0.5 * (clock.tick_length + max(clock.ticks - 1, 0) * clock.spacing - ahead)
        if step > most:
            clock.on_line = ahead + most
    step = max(min(step, most), 0.5 * min(clock.spacing, most))
    if step >= 1.0:
        clock.placed += <long long>step
        spread[0] += length == 0
    return clock.placed


cdef bint take_tick(Clock* clock, long long count) noexcept nogil:
    """
    Correct the line by a tick that came after `count` samples at the one before.

    Return False if time does not follow the line: it begins anew, and has its first sample.
    """
    cdef double error = -clock.on_line, n = clock.ticks + 1
    cdef bint lost = not fabs(error) < clock.ticks * clock.spacing
    if not lost and fabs(error) <= NEAR * clock.spacing:
        clock.ticks, clock.off_line = min(clock.ticks + 1, MOST_TICKS), 0
        clock.on_line += (4.0 * n - 2.0) / (n * (n + 1.0)) * error
        clock.spacing += 6.0 / (n * (n + 1.0)) * error / count
        return True
    clock.off_line += 1
    clock.ticks //= 2
    if clock.ticks > 1 and not lost:
        return True
    if clock.ticks < 2:  # a line through two ticks, if samples had the same reading
        clock.ticks = 2 if count > 1 else 0
        clock.spacing = <double>clock.tick_length / count
    # A tick that came early finds samples ahead of it: time goes on at half its speed.
    clock.on_line = max(0.0, difference(clock.placed, clock.tick) + 0.5 * clock.spacing)
    clock.placed = clock.tick + <long long>clock.on_line
    return False
