# SPDX-License-Identifier: Apache-2.0
"""
What samples of an arm say by themselves: whether they can be true, their time, their noise.

All arrays have one number for each joint.
"""

from libc.math cimport fabs, fmax, fmin, isfinite

import numpy as np

# Stamps are evened out over so many samples. Even intervals are used where velocities by them are
# rough by the factor at most; of what was remembered of both, KEEP is still remembered one sample
# later.
cdef int LONGEST = 200
cdef double BETTER = 0.8, KEEP = 0.995
# After so many stamps in a row that are off by half a period or more, the even clock starts from
# there; after GONE of them, it begins anew.
cdef int LATE = 5, GONE = 500
# The median of so many intervals is the period that the even clock begins with.
cdef int LEARNT = 20
# By such a share of a period a stamp has to be late until a sample is taken as missing.
cdef double MISSING = 0.7
# Samples over which noise is averaged, at the start and later; an impact counts as three standard
# deviations at most.
cdef int FIRST_LEARNT = 10, LONGEST_LEARNT = 1000
cdef double LARGEST = 9.0


cdef class Limits:
    """
    What an arm cannot have sent.

    Parameters
    ----------
    lowest, highest : (n,) array
        Positions, rad (m).
    fastest : (n,) array
        Velocity, rad/s (m/s).
    strongest : (n,) array
        Torque, N m (N).
    noise : (n,) array
        What noise may add to the difference of two positions, rad (m).

    """

    cdef double[::1] lowest, highest, fastest, strongest, noise

    def __init__(self, lowest, highest, fastest, strongest, noise):
        self.lowest, self.highest, self.fastest = lowest, highest, fastest
        self.strongest, self.noise = strongest, noise

    def fault(
        self, const double[::1] q, const double[::1] torque, const double[::1] velocity=None
    ):
        """Return why a sample can't be true, as a counter's name; nothing if it can."""
        cdef int k, n = self.lowest.shape[0]
        cdef bint moves = velocity is not None
        for k in range(n):
            if not (isfinite(q[k]) and isfinite(torque[k]) and (
                not moves or isfinite(velocity[k])
            )):
                return 'not finite'
        for k in range(n):
            if not self.lowest[k] <= q[k] <= self.highest[k]:
                return 'beyond limits'
            if not fabs(torque[k]) < self.strongest[k]:
                return 'too strong'
            if moves and not fabs(velocity[k]) < self.fastest[k]:
                return 'too fast'
        return ''

    def jumped(self, const double[::1] moved, double h):
        """Return True if no joint of this arm can have moved so far within h seconds."""
        cdef int k
        for k in range(moved.shape[0]):
            if fabs(moved[k]) > self.fastest[k] * h + self.noise[k]:
                return True
        return False


cdef class Noise:
    """
    The variance of the noise of samples, followed by their third differences.

    Parameters
    ----------
    size : (n,) array
        Standard deviation, to begin with.
    least : (n,) array
        The smallest that it can become.
    follows : (n,) array of bool
        Where it is followed, and not as it was told.

    """

    cdef readonly object variance  # (n,)
    cdef double[::1] now, least
    cdef double[:, ::1] before  # the three samples before
    cdef list follows
    cdef int seen, count

    def __init__(self, size, least, follows):
        self.variance = np.asarray(size, dtype=np.float64) ** 2
        self.now, self.least = self.variance, np.asarray(least, dtype=np.float64) ** 2
        self.before, self.follows = np.zeros((3, len(size))), list(follows)
        self.seen, self.count = 0, FIRST_LEARNT

    def reset(self):
        """Take the next sample as the first one."""
        self.seen = 0

    def take(self, const double[::1] sample):
        """Take a sample."""
        cdef double[:, ::1] b = self.before
        cdef double change, square
        cdef int k
        cdef bint known = self.seen >= 3
        if known:
            self.count = min(self.count + 1, LONGEST_LEARNT)
        for k in range(b.shape[1]):
            if known and self.follows[k]:
                change = sample[k] - 3.0 * (b[2, k] - b[1, k]) - b[0, k]
                square = fmin(change * change / 20.0, LARGEST * self.now[k])  # 1 + 9 + 9 + 1
                self.now[k] = fmax(
                    self.now[k] + (square - self.now[k]) / self.count, self.least[k]
                )
            b[0, k], b[1, k], b[2, k] = b[1, k], b[2, k], sample[k]
        self.seen = min(self.seen + 1, 3)


cdef class Clock:
    """
    The time between two samples, where stamps jitter more than the sampling does.

    Many drivers sample by a clock of the robot's controller, and stamp what they got when a thread
    of the host wakes up. A stamp that is 0.1 ms off makes a velocity of 10 % more, for one sample.
    So stamps are evened out, by the least squares of a line (constant period) over the last
    samples, written as an alpha-beta filter; whole periods may be missing. Intervals are those of
    the stamps or even ones, whichever make the smoother velocities.
    """

    cdef readonly bint even  # even intervals are used
    cdef readonly double apart  # by how much the two differ at the latest sample (s)
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
        self.even, self.apart, self.phase, self.period = False, 0.0, 0.0, 0.0
        self.count = self.off = 0
        self.first, self.speeds = [], None
        self.rough_by_stamps = self.rough_by_even = 0.0

    def interval(self, double h, const double[::1] moved):
        """Return the time in which the joints have `moved`; `h` is that of the stamps (s)."""
        cdef double even = self.evened(h), by_stamps = 0.0, by_even = 0.0, one, two
        cdef bint begins = self.speeds is None
        cdef int k
        self.apart = fabs(h - even)
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
        return even if self.even else h

    cdef double evened(self, double h):
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
        if fabs(off) > 0.5 * self.period:  # a stamp that says nothing, unless it goes on
            self.off += 1
            if self.off > GONE:
                self.count = self.off = 0
            self.phase = 0.0 if self.off % LATE == 0 else -off
            return steps * self.period
        self.off = 0
        self.count = n = min(self.count + 1, LONGEST)
        even = steps * self.period + 2.0 * (2.0 * n - 1.0) / (n * (n + 1.0)) * off
        self.phase = even - since
        self.period += 6.0 / (n * (n + 1.0)) * off / steps
        return even


def momentum_of(
    const double[:, ::1] before, const double[:, ::1] after, const double[::1] velocity,
    const double[::1] variance, double vague,
):
    """
    Return M v, and the covariance of its error: M S M' + (vague M v)(vague M v)'.

    Parameters
    ----------
    before, after : (n, n) array
        M is their mean.
    velocity : (n,) array
        v; or by how much positions have changed.
    variance : (n,) array
        The diagonal of S.
    vague : float
        Share of v that is not known.

    """
    cdef int i, j, k, n = velocity.shape[0]
    momentum, covariance, mean = np.zeros(n), np.zeros((n, n)), np.empty((n, n))
    cdef double[::1] p = momentum
    cdef double[:, ::1] r = covariance, mass = mean
    for i in range(n):
        for k in range(n):
            mass[i, k] = 0.5 * (before[i, k] + after[i, k])
            p[i] += mass[i, k] * velocity[k]
    for i in range(n):
        for j in range(n):
            r[i, j] = vague * p[i] * vague * p[j]
            for k in range(n):
                r[i, j] += mass[i, k] * variance[k] * mass[j, k]
    return momentum, covariance
