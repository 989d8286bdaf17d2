# SPDX-License-Identifier: Apache-2.0
"""What samples of an arm say by themselves: which can be used, their noise, and their time."""

from contextlib import suppress

from libc.math cimport fabs, floor, fmax, fmin, INFINITY, isnan, M_PI, NAN, sqrt

import numpy as np

# Stamps are evened out over so many samples. Even intervals are used where motion misses them by
# the factor at most; of what was remembered of both, KEEP is still remembered one sample later.
cdef int LONGEST = 200
cdef double BETTER = 0.8, KEEP = 0.995
# The median of so many intervals is the period that the even clock begins with.
cdef int LEARNT = 20
# By such a share of a period a stamp has to be late until a sample is taken as missing.
cdef double MISSING = 0.7
# Square of the standard deviations by which joints may miss where their velocity would bring them.
cdef double STRAIGHT = 100.0
# Steps of an encoder by which a position may be off, however near samples are.
cdef double OFF = 3.0
# A driver may publish what it has read so many times more.
cdef int MOST_REPEATS = 10
# Samples over which noise is averaged, at the start and later; an impact counts as three standard
# deviations at most.
cdef int FIRST_LEARNT = 10, LONGEST_LEARNT = 1000
cdef double LARGEST = 9.0
# Seconds without a sample, or back in time, after which one is a first one.
cdef double MAX_GAP = 0.1


FAULTS = ('too strong', 'beyond limits', 'too fast')
"""What an effort, a position and a velocity can be that no arm has."""


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
    cdef int count  # of what is averaged

    def __cinit__(self, size, least, most):
        self.now, self.least, self.most = np.square(np.broadcast_arrays(size, least, most))
        self.variance = np.asarray(self.now)
        self.before = np.full((3, *self.variance.shape), np.nan)
        self.count = FIRST_LEARNT

    def reset(self):
        """Take the next sample as the first one."""
        self.before[:, :, :] = NAN

    cdef void take(self, const double[:, ::1] sample) noexcept:
        """Take a sample, (r, n)."""
        cdef double[:, :, ::1] b = self.before
        cdef double change, square, found
        cdef Py_ssize_t i, k
        cdef bint known = not isnan(b[0, 0, 0])
        if known:
            self.count = min(self.count + 1, LONGEST_LEARNT)
        for i in range(self.now.shape[0]):
            for k in range(self.now.shape[1]):
                if known:
                    change = sample[i, k] - 3.0 * (b[2, i, k] - b[1, i, k]) - b[0, i, k]
                    square = fmin(change * change / 20.0, LARGEST * self.now[i, k])  # 1+9+9+1
                    found = self.now[i, k] + (square - self.now[i, k]) / self.count
                    self.now[i, k] = fmin(fmax(found, self.least[i, k]), self.most[i, k])
                b[0, i, k], b[1, i, k], b[2, i, k] = b[1, i, k], b[2, i, k], sample[i, k]


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

    cdef readonly bint even  # even intervals are used
    cdef readonly double vague  # share of what has moved at the latest sample that is not known
    cdef double phase  # of the even clock, from the latest stamp (s)
    cdef double period  # s
    cdef int count  # stamps evened out
    cdef list first  # intervals before the even clock begins
    cdef double missed_by_stamps, missed_by_even  # rad^2, of the latest samples

    def __cinit__(self):
        self.reset()

    def reset(self):
        """Forget everything."""
        self.even, self.count = False, 0
        self.vague = self.phase = self.period = 0.0
        self.missed_by_stamps = self.missed_by_even = 0.0
        self.first = []

    cpdef double interval(
        self, double h, const double[::1] moved, const double[::1] velocity,
        const double[::1] variance,
    ) except -1.0:
        """
        Return the time in which the joints have `moved`; `h` is that of the stamps (s).

        `velocity` is the one before, and `variance` that of the noise of positions.
        """
        cdef double total = 0.0, along = 0.0, square = 0.0, noise = 0.0, even
        cdef double told = h, sure = INFINITY  # time by the motion, and how exact it is (s)
        cdef Py_ssize_t k, n = moved.shape[0]
        if not n == velocity.shape[0] == variance.shape[0]:
            raise ValueError(f'expected arrays of {n} joints')
        for k in range(n):
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

    Samples are (3, n): efforts, positions and velocities.

    Parameters
    ----------
    noise : Noise
    constants : (n,) array
        Torque for a unit of effort.
    lowest, highest : (3, n) array
        What an arm can have.
    step : (n,) array
        Of the encoders.
    stopping : (n,) array
        Torques by which no arm is stopped between two samples.
    turning : (n,) array of bool
        Joints whose angle has no end.
    of_position : bool
        True if positions say how the joints have moved, False if velocities do.

    """

    cdef readonly double h, vague  # time in which the joints moved, and share that is not known
    cdef readonly object way, change, speed  # (n,): moved, what `Bank.step` takes, velocities
    # The latest sample, and its rows: written anew by the next one.
    cdef readonly object sample, torque, position, velocity
    cdef readonly Noise noise
    cdef readonly Clock clock
    cdef double[:, ::1] lowest, highest
    cdef double[:, ::1] now
    cdef double[::1] constants, step, stopping, rest, before, moved, rate
    cdef unsigned char[::1] turning
    cdef bint of_position, begun, still
    cdef int repeats  # samples in a row that a driver has published once more
    cdef long long time, newest  # of the latest sample that counts, and of any

    def __cinit__(
        self, Noise noise not None, constants, lowest, highest, step, stopping, turning,
        bint of_position,
    ):
        cdef Py_ssize_t n = len(step)
        given = noise.variance, lowest, highest, constants, step, stopping, turning
        if [*map(np.shape, given)] != [(3, n)] * 3 + [(n,)] * 4:
            raise ValueError(f'expected arrays of {n} joints')
        self.noise, self.clock = noise, Clock()
        self.of_position, self.constants = of_position, np.array(constants, dtype=np.float64)
        self.now = self.sample = np.zeros((3, n))
        self.torque, self.position, self.velocity = self.sample
        self.lowest, self.highest, self.step, self.stopping = lowest, highest, step, stopping
        self.turning = np.array(turning, dtype=np.uint8)
        self.rest, self.before, self.moved, self.rate = np.zeros((4, n))
        self.way, self.speed = np.asarray(self.moved), np.asarray(self.rate)
        self.change = self.way if of_position else self.speed
        self.newest = -(1 << 62)
        self.reset()

    def reset(self):
        """Take the next sample as the first one."""
        self.begun = self.still = False
        self.repeats = 0
        self.clock.reset()
        self.noise.reset()

    cpdef bint is_possible(self, int row, const double[::1] values) except -1:
        """Return True if an arm can have these values, (n,), in a row of a sample."""
        cdef int k, n = self.step.shape[0]
        if not 0 <= row < 3 or values.shape[0] != n:
            raise ValueError(f'expected a row of 3 and {n} joints')
        for k in range(n):
            if not self.lowest[row, k] < values[k] < self.highest[row, k]:
                return False
        return True

    def take(self, long long time, effort, position, velocity, known, const double[::1] motion):
        """
        Go on to a sample.

        Parameters
        ----------
        time : int
            ns.
        effort, position, velocity : (n,) array
        known : (n,) array or None
            Velocity estimated at the sample before; None if it is not known yet.
        motion : (n,) array
            M times `change` of the sample before.

        Returns
        -------
        str
            Empty if the sample can be used, else why not: one of `FAULTS` or 'wrong size', 'not
            finite', 'not newer', 'standing still', 'repeated' (a joint that moves by more than a
            step of its encoder shows it), 'jumped', after which the next sample is the first; and
            the first one itself, 'first', 'clock set back' or 'restarts' (after a gap).

        """
        cdef const double[::1] likely = self.rest if known is None else known
        cdef int i, k, n = self.step.shape[0]
        cdef double over  # what divides `motion` to have p
        cdef bint moves = False, repeated = False, back
        if not n == likely.shape[0] == motion.shape[0]:
            raise ValueError(f'expected arrays of {n} joints')
        given = effort, position, velocity
        for i in range(3):
            if not self.read(i, given[i]):
                return 'wrong size'
        for i in range(3):
            if not self.is_possible(i, self.now[i]):
                return FAULTS[i] if np.isfinite(self.sample).all() else 'not finite'
        back = time < self.newest - MAX_GAP * 1e9
        if time <= self.newest and not back:
            return 'not newer'
        self.newest = time
        if back or not self.begun:
            return self.begin(time, 'clock set back' if back else 'first')
        over = self.h if self.of_position else 1.0
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
                self.still = self.still or fabs(motion[k]) > self.stopping[k] * self.h * over
        if repeated and self.repeats < MOST_REPEATS:
            self.repeats += 1
            return 'repeated'
        if self.still:
            return 'standing still'
        if self.h > MAX_GAP:
            return self.begin(time, 'restarts')
        self.h = self.clock.interval(self.h, self.moved, likely, self.noise.now[1])
        for k in range(n):
            if fabs(self.moved[k]) > self.highest[2, k] * self.h + OFF * self.step[k]:
                self.reset()
                return 'jumped'
            self.rate[k] = self.moved[k] / self.h if self.of_position else self.now[2, k]
        self.vague = self.clock.vague if self.of_position else 0.0
        self.noise.take(self.now)
        self.time, self.before[:] = time, self.now[1]
        return ''

    cdef bint read(self, int row, numbers) except -1:
        """Take a row of a sample; return False if it has another size, or is not of numbers."""
        cdef const double[:] values = None
        cdef int k
        try:
            values = numbers
        except (TypeError, ValueError):  # no array of doubles, as library users may have them
            with suppress(TypeError, ValueError):
                values = np.asarray(numbers, dtype=np.float64)
        if values is None or values.shape[0] != self.step.shape[0]:
            return False
        for k in range(values.shape[0]):
            self.now[row, k] = values[k] * (1.0 if row else self.constants[k])
        return True

    cdef str begin(self, long long time, str problem):
        """Take a sample as the first one, and return why it is that."""
        self.reset()
        self.begun, self.time, self.before[:] = True, time, self.now[1]
        return problem
