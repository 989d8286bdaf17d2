# SPDX-License-Identifier: Apache-2.0
"""What samples of an arm say by themselves: their noise, and their time."""

from libc.math cimport fabs, fmax, fmin, INFINITY, sqrt

import numpy as np

# Stamps are evened out over so many samples. Even intervals are used where velocities by them are
# rough by the factor at most; of what was remembered of both, KEEP is still remembered one sample
# later.
cdef int LONGEST = 200
cdef double BETTER = 0.8, KEEP = 0.995
# After so many stamps in a row that are off by half a period or more, the even clock begins anew.
cdef int GONE = 500
# The median of so many intervals is the period that the even clock begins with.
cdef int LEARNT = 20
# By such a share of a period a stamp has to be late until a sample is taken as missing.
cdef double MISSING = 0.7
# Square of the standard deviations by which joints may miss where their velocity would bring them.
cdef double STRAIGHT = 100.0
# Samples over which noise is averaged, at the start and later; an impact counts as three standard
# deviations at most.
cdef int FIRST_LEARNT = 10, LONGEST_LEARNT = 1000
cdef double LARGEST = 9.0


def outside(
    const double[:, ::1] sample, const double[:, ::1] lowest, const double[:, ::1] highest
):
    """Return the first row with a number that is not between its bounds, -1 if all are."""
    cdef int i, k
    if not (
        sample.shape[0] == lowest.shape[0] == highest.shape[0]
        and sample.shape[1] == lowest.shape[1] == highest.shape[1]
    ):
        raise ValueError('expected arrays of one shape')
    for i in range(sample.shape[0]):
        for k in range(sample.shape[1]):
            if not lowest[i, k] < sample[i, k] < highest[i, k]:
                return i
    return -1


def farther(
    const double[::1] moved, const double[::1] fastest, double h, const double[::1] noisy
):
    """Return whether a joint has moved farther than is possible within h, and by noise."""
    cdef int k
    if not moved.shape[0] == fastest.shape[0] == noisy.shape[0]:
        raise ValueError('expected arrays of one length')
    for k in range(moved.shape[0]):
        if fabs(moved[k]) > fastest[k] * h + noisy[k]:
            return True
    return False


cdef class Noise:
    """
    The variance of the noise of samples, followed by their third differences.

    Parameters
    ----------
    size : (r, n) array
        Standard deviation of r kinds of samples, to begin with.
    least, most : (r, n) array
        The smallest and the largest that it can become.

    """

    cdef readonly object variance  # (r, n)
    cdef double[:, ::1] now, least, most
    cdef double[:, :, ::1] before  # the three samples before
    cdef int seen, count

    def __init__(self, size, least, most):
        self.now, self.least, self.most = np.square(size), np.square(least), np.square(most)
        self.variance = np.asarray(self.now)
        self.before = np.zeros((3, *self.variance.shape))
        self.seen, self.count = 0, FIRST_LEARNT

    def reset(self):
        """Take the next sample as the first one."""
        self.seen = 0

    def take(self, const double[:, ::1] sample):
        """Take a sample, (r, n)."""
        cdef double[:, :, ::1] b = self.before
        cdef double change, square, found
        cdef int i, k, rows = self.now.shape[0], n = self.now.shape[1]
        cdef bint known = self.seen >= 3
        if sample.shape[0] != rows or sample.shape[1] != n:
            raise ValueError(f'expected a sample of shape {(rows, n)}')
        if known:
            self.count = min(self.count + 1, LONGEST_LEARNT)
        for i in range(rows):
            for k in range(n):
                if known:
                    change = sample[i, k] - 3.0 * (b[2, i, k] - b[1, i, k]) - b[0, i, k]
                    square = fmin(change * change / 20.0, LARGEST * self.now[i, k])  # 1+9+9+1
                    found = self.now[i, k] + (square - self.now[i, k]) / self.count
                    self.now[i, k] = fmin(fmax(found, self.least[i, k]), self.most[i, k])
                b[0, i, k], b[1, i, k], b[2, i, k] = b[1, i, k], b[2, i, k], sample[i, k]
        self.seen = min(self.seen + 1, 3)


cdef class Clock:
    """
    The time between two samples, where stamps jitter more than the sampling does.

    Many drivers sample by a clock of the robot's controller, and stamp what they got when a thread
    of the host wakes up. A stamp that is 0.1 ms off makes a velocity of 10 % more, for one sample.
    So stamps are evened out, by the least squares of a line (constant period) over the last
    samples, written as an alpha-beta filter; whole periods may be missing. Intervals are those of
    the stamps or even ones, whichever make the smoother velocities.

    A host that hangs stamps one sample late, and those after it at nearly the same time. Where
    stamps and even clock do not agree to half a period, or samples seem to be missing, encoders
    are the third clock: joints move on with their velocity, and how far they have moved tells the
    time that has passed.
    """

    cdef readonly bint even  # even intervals are used
    cdef readonly double vague  # share of what has moved at the latest sample that is not known
    cdef double phase  # of the even clock, from the latest stamp (s)
    cdef double period  # s
    cdef int count, off  # stamps evened out, and those in a row that say nothing
    cdef list first  # intervals before the even clock begins
    cdef double[:, ::1] speeds  # at the sample before, by stamps and by even intervals
    cdef double rough_by_stamps, rough_by_even

    def __init__(self):
        self.reset()

    def reset(self):
        """Forget everything."""
        self.even, self.vague, self.phase, self.period = False, 0.0, 0.0, 0.0
        self.count = self.off = 0
        self.first, self.speeds = [], None
        self.rough_by_stamps = self.rough_by_even = 0.0

    def interval(
        self, double h, const double[::1] moved, const double[::1] velocity,
        const double[::1] variance,
    ):
        """
        Return the time in which the joints have `moved`; `h` is that of the stamps (s).

        `velocity` is the one before, and `variance` that of the noise of positions.
        """
        cdef double by_stamps = 0.0, by_even = 0.0, total = 0.0, along = 0.0, square = 0.0
        cdef double noise = 0.0, even, one, two
        cdef double told = h, sure = INFINITY  # time by the motion, and how exact it is (s)
        cdef bint begins
        cdef int k
        for k in range(moved.shape[0]):
            total += moved[k] * moved[k]
            along += moved[k] * velocity[k]
            square += velocity[k] * velocity[k]
            noise += variance[k]
        if square > 0.0:
            told = along / square
            if total - told * along <= STRAIGHT * noise:
                sure = sqrt(LARGEST * noise / square)
        even = self.evened(h, told, sure)
        if fabs(h - even) > 0.5 * self.period:
            self.speeds = None
            if fabs(h - told) < fabs(even - told):
                even = h
            self.vague = fabs(even - told) / fmax(fabs(told), 1e-15)
            return even
        begins = self.speeds is None
        if begins:
            self.speeds = np.zeros((2, moved.shape[0]))
        for k in range(moved.shape[0]):
            one, two = moved[k] / h, moved[k] / even
            by_stamps += (one - self.speeds[0, k]) * (one - self.speeds[0, k])
            by_even += (two - self.speeds[1, k]) * (two - self.speeds[1, k])
            self.speeds[0, k], self.speeds[1, k] = one, two
        if not begins:
            self.rough_by_stamps = KEEP * self.rough_by_stamps + by_stamps
            self.rough_by_even = KEEP * self.rough_by_even + by_even
        self.even = self.rough_by_even < BETTER * self.rough_by_stamps
        one = even if self.even else h
        self.vague = fabs(h - even) / one
        return one

    cdef double evened(self, double h, double told, double sure):
        """Go on by a stamp, `h` after the one before, and return the even interval."""
        cdef double since = h - self.phase, off, even
        cdef int steps, n
        if self.count == 0:
            self.first.append(h)
            if len(self.first) == LEARNT:
                self.period, self.phase = float(np.median(self.first)), 0.0
                self.count = LEARNT // 2
                self.first.clear()
            return h
        steps = max(1, int(since / self.period + 1.0 - MISSING))
        off = since - steps * self.period
        if (
            fabs(steps * self.period - told) > sure
            and (fabs(off) > 0.5 * self.period or told < (0.5 * steps + 1.0) * self.period)
        ):
            steps = max(1, <int> (fmin(told, since) / self.period + 0.5))
            off = since - steps * self.period
        if fabs(off) > 0.5 * self.period:  # a stamp that says nothing, unless it goes on
            self.off += 1
            if self.off > GONE:
                self.count = self.off = 0
            self.phase = 0.0 if fabs(h - steps * self.period) < 0.5 * self.period else -off
            return steps * self.period
        self.off = 0
        self.count = n = min(self.count + 1, LONGEST)
        even = steps * self.period + 2.0 * (2.0 * n - 1.0) / (n * (n + 1.0)) * off
        self.phase = even - since
        self.period += 6.0 / (n * (n + 1.0)) * off / steps
        return even
