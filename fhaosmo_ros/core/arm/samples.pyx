# SPDX-License-Identifier: Apache-2.0
"""What samples of an arm say by themselves: which can be used, their noise, and their time."""

from libc.math cimport fabs, floor, fmax, fmin, isnan, M_PI, NAN, sqrt

import numpy as np

# Shares of what a stamp is off the line by that its sample, and the period, are moved by; and of
# a period, which it may be off.
cdef double FOLLOW = 0.2, QUICKEN = 0.01, NEAR = 0.4
# Variances by which an interval of stamps may differ from what the motion of the joints tells.
cdef double AGREES = 25.0
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
    # The interval of samples by their stamps, and by how much the latest stamp is late (s); the
    # variance of stamps.
    cdef double period, late, jitter

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
        self.period = self.late = self.jitter = 0.0
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
            e, q, v = effort, position, velocity
        except (TypeError, ValueError):  # no arrays of doubles, as library users may have them
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
        self.tell_time(likely)
        for k in range(n):
            if fabs(self.moved[k]) > (
                self.highest[2, k] * fmax(self.h, self.period) + OFF * self.step[k]
            ):
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

    cdef void tell_time(self, const double[::1] velocity):
        """
        Find out in which time the joints have moved, and how exactly that is known.

        Many drivers sample by a clock of the robot's controller, and stamp what they got when a
        thread of the host wakes up. A stamp that is 0.1 ms off makes a velocity of 10 % more, for
        one sample. So samples follow a line through the stamps (an alpha-beta filter), in which
        whole periods may be missing, and how far stamps are off it is noise of the time.

        A host that hangs stamps one sample late, and those after it at nearly the same time; or
        its clock is set. Where an interval is no period, joints tell the time: they move on with
        the `velocity` that they had.
        """
        cdef double along = 0.0, square = 0.0, noise = 0.0, told, h, count, off, miss, unsure
        cdef bint agrees
        cdef Py_ssize_t k
        if self.period == 0.0:
            self.period = self.h
        for k in range(velocity.shape[0]):
            along += self.moved[k] * velocity[k]
            square += velocity[k] * velocity[k]
            noise += self.found[1, k]
        h = self.h + self.late
        told = along / square if along > 0.0 else fmax(h, self.h)
        if (
            fabs(self.h - self.period) < 0.5 * self.period < fabs(self.late)
            and fabs(self.h - told) < fabs(h - told)
        ):
            h = self.h  # the clock was set
        miss = (h - told) ** 2
        agrees = h > 0.0 and miss * square <= AGREES * (noise + self.jitter * square)
        count = fmax(1.0, floor(h / self.period + 0.5))
        off = h - count * self.period
        if agrees or (count == 1.0 and fabs(off) <= NEAR * self.period):
            self.h = h
            self.period += QUICKEN * off / count
            if fabs(off) <= NEAR * self.period:  # else there is another rate now
                self.h -= (1.0 - FOLLOW) * off
                off = fmin(off * off, LARGEST * self.jitter + 1e-14)
                self.jitter += (off - self.jitter) / self.count
            unsure = self.jitter if count == 1.0 else self.jitter + miss
        else:  # the sample says next to nothing of the velocity
            self.period += QUICKEN * (fmin(fmax(told, self.h), 2.0 * self.period) - self.period)
            self.h, unsure = told, told * told
        self.late = h - self.h
        self.vague = sqrt(unsure) / self.h if self.of_position else 0.0

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
