# SPDX-License-Identifier: Apache-2.0
"""What samples of an arm say by themselves: which can be used, their noise, and their time."""

from libc.math cimport fabs, floor, fmax, fmin, INFINITY, isnan, M_PI, NAN, sqrt

import numpy as np

cdef int LONGEST = 200  # samples over which stamps are evened out
# Even intervals are used where motion misses them by the factor at most; of what was remembered of
# both kinds of intervals, KEEP is still remembered one sample later.
cdef double BETTER = 0.8, KEEP = 0.995
cdef int LEARNT = 20  # the even clock begins with the median of so many intervals
cdef double MISSING = 0.7  # share of a period by which a stamp is late where a sample is missing
# Square of the standard deviations by which joints may miss where their velocity would bring them.
cdef double STRAIGHT = 100.0
cdef double STEP = sqrt(12.0)  # of an encoder, in standard deviations of its error of rounding
cdef double OFF = 3.0  # of these steps a position may be off, however near samples are
cdef int MOST_REPEATS = 10  # so many times more a driver may publish what it has read
# Samples over which noise is averaged, at the start and later; an impact counts as three standard
# deviations at most.
cdef int FIRST_LEARNT = 10, LONGEST_LEARNT = 1000
cdef double LARGEST = 9.0
cdef double MAX_GAP = 0.1  # s without a sample, or back in time, after which one is a first one

FAULTS = ('too strong', 'beyond limits', 'too fast')
"""What an effort, a position and a velocity can be that no arm has."""


cdef class Clock:
    """
    The time between two samples, where stamps jitter more than the sampling does.

    Many drivers sample by a clock of the robot's controller, and stamp what they got when a thread
    of the host wakes up. A stamp that is 0.1 ms off makes a velocity of 10 % more, for one sample.
    So stamps are evened out, by the least squares of a line (constant period) over the last
    samples, written as an alpha-beta filter; whole periods may be missing. Intervals are those of
    the stamps or even ones, whichever agree better with how the joints move on.

    A host that hangs stamps one sample late, and those after it at nearly the same time. Where
    stamps and even clock do not agree to half a period, or samples seem to be missing, encoders
    are the third clock: joints move on with their velocity, and how far they have moved tells the
    time that has passed. Where that is as the stamp says, the even clock begins anew.
    """

    cdef bint even  # even intervals are used
    cdef double vague  # share of what has moved at the latest sample that is not known
    cdef double phase  # of the even clock, from the latest stamp (s)
    cdef double period  # s
    cdef int count  # stamps evened out
    cdef list first  # intervals before the even clock begins
    cdef double missed_by_stamps, missed_by_even  # rad^2, of the latest samples

    def __cinit__(self):
        self.first = []

    cdef double interval(
        self, double h, const double[::1] moved, const double[::1] velocity,
        const double[::1] variance,
    ):
        """
        Return the time in which the joints have `moved`; `h` is that of the stamps (s).

        `velocity` is the one before, and `variance` that of the noise of positions.
        """
        cdef double total = 0.0, along = 0.0, square = 0.0, noise = 0.0, even
        cdef double told = h, sure = INFINITY  # time by the motion, and how exact it is (s)
        cdef Py_ssize_t k
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
        if fabs(h - even) > 0.5 * self.period or (self.count == 0 and sure < h):
            if fabs(h - told) < fabs(even - told):
                even = h
            self.vague = fabs(even - told) / fmax(fabs(told), 1e-15)
            return even
        # By how much the joints miss where their velocity would have brought them.
        self.missed_by_stamps *= KEEP
        self.missed_by_stamps += total - 2.0 * h * along + h * h * square
        self.missed_by_even *= KEEP
        self.missed_by_even += total - 2.0 * even * along + even * even * square
        self.even = self.missed_by_even < BETTER * self.missed_by_stamps
        self.vague = fabs(h - even) / (even if self.even else h)
        return even if self.even else h

    cdef double evened(self, double h, double told, double sure):
        """Go on by a stamp, `h` after the one before, and return the even interval."""
        cdef double since = h - self.phase, off, even
        cdef int steps, n
        if self.count == 0:
            self.first.append(h)
            if len(self.first) == LEARNT:
                self.period, self.phase = float(np.median(self.first)), 0.0
                self.count, self.first = LEARNT // 2, []
            return h
        steps = max(1, int(since / self.period + 1.0 - MISSING))
        off = since - steps * self.period
        if (
            fabs(steps * self.period - told) > sure
            and (fabs(off) > 0.5 * self.period or told < (0.5 * steps + 1.0) * self.period)
        ):
            steps = max(1, <int> (fmin(told, since) / self.period + 0.5))
            off = since - steps * self.period
        if fabs(off) > 0.5 * self.period:  # says nothing, unless joints have moved as it says
            even = steps * self.period
            self.phase = 0.0 if fabs(h - even) < 0.5 * self.period else -off
            if fabs(h - told) < fabs(even - told):
                self.count = 0
            return even
        self.count = n = min(self.count + 1, LONGEST)
        even = steps * self.period + 2.0 * (2.0 * n - 1.0) / (n * (n + 1.0)) * off
        self.phase = even - since
        self.period += 6.0 / (n * (n + 1.0)) * off / steps
        return even


cdef class Samples:
    """
    How the joints have moved from one sample to the next, in which time, and how noisy that is.

    A sample is (3, n): efforts, positions and velocities. `noise` (3, n) are the standard
    deviations of its noise to begin with, and `least` (3, n) the least ones that are found;
    `limits` (2, 3, n) lie below and above what an arm can have. `constants` (n,) are the torques
    for a unit of effort, and torques of `stopping` (n,) stop no arm between two samples. The
    angles of `turning` (n,) joints have no end. Positions say how the joints have moved if
    `of_position` is true, else velocities do.
    """

    cdef readonly double h, vague  # time in which the joints moved (s), and share not known of it
    # (4, n) torque, position and velocity of the latest sample, and how far the joints moved:
    # written anew by the next one.
    cdef readonly object latest
    cdef readonly object variance  # (3, n) of the noise of samples
    cdef double[:, ::1] now, found, least, lowest, highest
    cdef double[:, :, ::1] past  # the three samples before
    cdef double[::1] constants, stopping, step, rest, before, moved
    cdef unsigned char[::1] turning
    cdef bint of_position, begun, still
    cdef int count  # samples over which noise is averaged
    cdef int repeats  # samples in a row that a driver has published once more
    cdef long long time, newest  # of the latest sample that counts, and of any
    cdef Clock clock

    def __cinit__(self, noise, least, limits, constants, stopping, turning, bint of_position):
        cdef Py_ssize_t n = len(constants)
        if not np.shape(noise) == np.shape(least) == (3, n) or np.shape(limits) != (2, 3, n):
            raise ValueError(f'expected noise and limits of {n} joints')
        self.variance, self.least = np.square((noise, least))
        self.found, self.past = self.variance, np.zeros((3, 3, n))
        self.lowest, self.highest = limits
        self.constants, self.stopping = np.array([constants, stopping])
        self.turning = np.array(turning, dtype=np.uint8)
        self.of_position, self.step = of_position, STEP * noise[1]
        self.rest, self.before = np.zeros((2, n))
        self.latest = np.zeros((4, n))
        self.now, self.moved = self.latest[:3], self.latest[3]
        self.count, self.newest = FIRST_LEARNT, -(1 << 62)
        self.reset()

    def reset(self):
        """Take the next sample as the first one."""
        self.begun = self.still = False
        self.repeats = 0
        self.clock = Clock()
        self.past[:, :, :] = NAN

    cpdef bint is_possible(self, int row, const double[::1] values) except -1:
        """Return True if an arm can have these values, (n,), in a row of a sample."""
        cdef int k, n = self.step.shape[0]
        if not 0 <= row < 3 or values.shape[0] != n:
            raise ValueError(f'expected a row of 3 and {n} joints')
        for k in range(n):
            if not self.lowest[row, k] < values[k] < self.highest[row, k]:
                return False
        return True

    def take(self, long long time, effort, position, velocity, known, const double[::1] momentum):
        """
        Go on to a sample of a `time` in ns, and return why it cannot be used, '' if it can.

        `known` (n,) is the velocity estimated at the sample before, None if there is none yet, and
        `momentum` (n,) M times that. What cannot be used is one of `FAULTS`, or 'wrong size', 'not
        finite', 'not newer', 'standing still', 'repeated' (a joint that moves by more than a step
        of its encoder shows it), 'jumped', after which the next sample is the first; and the first
        one itself, 'first', 'clock set back' or 'restarts' (after a gap).
        """
        cdef const double[::1] likely = self.rest if known is None else known
        cdef const double[:] e, q, v
        cdef int i, k, n = self.step.shape[0]
        cdef bint moves = False, repeated = False, back
        if not n == likely.shape[0] == momentum.shape[0]:
            raise ValueError(f'expected arrays of {n} joints')
        try:
            e, q, v = [np.asarray(a, dtype=np.float64) for a in (effort, position, velocity)]
        except (TypeError, ValueError):
            return 'wrong size'
        if not n == e.shape[0] == q.shape[0] == v.shape[0]:
            return 'wrong size'
        for k in range(n):
            self.now[0, k], self.now[1, k], self.now[2, k] = self.constants[k] * e[k], q[k], v[k]
        for i in range(3):
            if not self.is_possible(i, self.now[i]):
                return FAULTS[i] if np.isfinite(self.now).all() else 'not finite'
        back = time < self.newest - MAX_GAP * 1e9
        if time <= self.newest and not back:
            return 'not newer'
        self.newest = time
        if back or not self.begun:
            return self.begin(time, 'clock set back' if back else 'first')
        self.h = (time - self.time) * 1e-9
        for k in range(n):
            self.moved[k] = self.now[1, k] - self.before[k]
            if self.turning[k]:  # the shorter way
                self.moved[k] -= 2.0 * M_PI * floor(self.moved[k] / (2.0 * M_PI) + 0.5)
            moves = moves or self.moved[k] != 0.0
        if moves:
            self.still, self.repeats = False, 0
        elif known is not None:  # to the bit, and all joints at once
            for k in range(n):
                repeated = repeated or fabs(likely[k]) * self.h > self.step[k]
                self.still = self.still or fabs(momentum[k]) > self.stopping[k] * self.h
        if repeated and self.repeats < MOST_REPEATS:
            self.repeats += 1
            return 'repeated'
        if self.still:
            return 'standing still'
        if self.h > MAX_GAP:
            return self.begin(time, 'restarts')
        self.h = self.clock.interval(self.h, self.moved, likely, self.found[1])
        self.vague = self.clock.vague if self.of_position else 0.0
        for k in range(n):
            if fabs(self.moved[k]) > self.highest[2, k] * self.h + OFF * self.step[k]:
                self.reset()
                return 'jumped'
        self.learn_noise()
        self.time, self.before[:] = time, self.now[1]
        return ''

    cdef str begin(self, long long time, str problem):
        """Take a sample as the first one, and return why it is that."""
        self.reset()
        self.begun, self.time, self.before[:] = True, time, self.now[1]
        return problem

    cdef void learn_noise(self):
        """Follow the variance of the noise by third differences."""
        cdef double[:, :, ::1] b = self.past
        cdef double change, square, found
        cdef Py_ssize_t i, k
        cdef bint known = not isnan(b[0, 0, 0])
        if known:
            self.count = min(self.count + 1, LONGEST_LEARNT)
        for i in range(3):
            for k in range(self.step.shape[0]):
                if known:
                    change = self.now[i, k] - 3.0 * (b[2, i, k] - b[1, i, k]) - b[0, i, k]
                    square = fmin(change * change / 20.0, LARGEST * self.found[i, k])  # 1+9+9+1
                    found = self.found[i, k] + (square - self.found[i, k]) / self.count
                    self.found[i, k] = fmax(found, self.least[i, k])
                b[0, i, k], b[1, i, k], b[2, i, k] = b[1, i, k], b[2, i, k], self.now[i, k]
