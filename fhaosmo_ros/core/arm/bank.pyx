# SPDX-License-Identifier: Apache-2.0
"""
Interacting filters over all joints of an arm: one for free motion, the others for contact.

Each filter has the state Y, p, d of every joint (docs/arm.md):

    Y' = p,   p' = u + d,   d' = -decay d + white noise of intensity W

and so all joints share one transition; only their covariances are coupled. The filters differ in
decay and W. They interact as in H. Blom and Y. Bar-Shalom, IEEE Transactions on Automatic Control
33(8), 1988, doi:10.1109/9.1299.
"""

from fhaosmo_ros.core.vectors cimport VECTORISED
from libc.math cimport exp, expm1, fmax, log, sqrt

import numpy as np

# The lower of log-weights: no filter is given up for good.
cdef double SMALLEST = 1e-30


cdef class Bank:
    """
    The filters, their states and weights.

    Parameters
    ----------
    free_intensity : (n,) array
        W of free motion on its diagonal: torque^2 / s.
    decay : float
        Of d in free motion, 1/s; in contact d does not decay.
    scales : (m,) array
        Of the contact filters: W is scale^2 times `shape` of `step`, and that of free motion.
    rates : three floats
        1/s, at which contact begins and ends, and at which its intensity changes.
    variance : (3, n) array
        Of the noise of efforts, positions and velocities, from sample to sample; may change.
    onset, since : float
        Where contact begins, d may have jumped by so many seconds of W, at any time within the
        last `since` seconds: else a force that is there at once would be taken for one that still
        grows, and what it has done to Y and p until it is seen for more force.
    of_position : bool
        True if Y is measured, False if p is.

    """

    cdef int joints, filters
    cdef bint of_position
    cdef readonly double log_odds  # of contact against free motion
    cdef readonly object mean  # (3, n): Y, of positions less what was measured, p and d
    cdef readonly object covariance  # (n, n) of d, if the likeliest filter is right
    cdef double decay, begin, end, change, onset, since
    cdef double[::1] free, measured, average
    cdef double[::1] w  # weight of each filter, the first of free motion
    cdef double[::1] scales  # scale^2 of each filter
    # Of each filter, and of what those of contact have in common: Y of all joints, p of all and
    # d of all, and below their covariance.
    cdef double[:, :, ::1] s
    # Of each filter: its weight before the sample, which share of it has just begun, and how
    # likely the sample was to it.
    cdef double[::1] mixed, anew, likelihood
    cdef double[:, ::1] work  # S, H P and the innovation, side by side
    cdef double[:, ::1] spread, noise
    cdef const double[:, ::1] variance
    # M and u at the sample before, and between it and the next one.
    cdef double[:, ::1] mass, middle
    cdef double[::1] drive, mean_drive

    def __cinit__(
        self, free_intensity, double decay, scales, rates, variance, double onset=0.0,
        double since=0.0, bint of_position=True,
    ):
        cdef int n = len(free_intensity), m = len(scales) + 1
        self.joints, self.filters, self.of_position = n, m, of_position
        self.free = np.array(free_intensity, dtype=np.float64)
        self.variance = variance
        if variance.shape != (3, n):
            raise ValueError(f'expected variances of {n} joints')
        self.scales = np.square([0.0, *scales])
        self.decay, (self.begin, self.end, self.change) = decay, rates
        self.onset, self.since = onset, fmax(since, 1e-15)
        self.s = np.zeros((m + 1, 3 * n + 1, 3 * n))
        self.work = np.zeros((n, 4 * n + 1))
        self.mean, self.covariance = np.zeros((3, n)), np.zeros((n, n))
        self.average, self.spread = self.mean.reshape(-1), self.covariance
        self.w, self.mixed, self.anew, self.likelihood = np.zeros((4, m))
        self.mass, self.middle, self.noise = np.zeros((3, n, n))
        self.drive, self.mean_drive, self.measured = np.zeros((3, n))
        self.start(1.0, np.zeros((n, n)), np.zeros(n), 0.0, np.zeros(n))

    def start(self, double h, mass, change, drive, variance):
        """
        Begin as if the arm had moved for long, so that it may be in contact.

        The first sample is as in `step`; `variance` (n,) is that of d in contact.
        """
        cdef int n = self.joints
        cdef double contact = fmax(self.begin / fmax(self.begin + self.end, SMALLEST), SMALLEST)
        cdef double unit = h if self.of_position else 1.0  # `change` by this is a velocity
        wide = 2.0 * np.asarray(self.variance)[1 if self.of_position else 2] / (unit * unit)
        np.asarray(self.mass)[...], np.asarray(self.drive)[...] = mass, drive
        s = np.asarray(self.s)
        s[...] = 0.0
        s[:, 0, n : 2 * n] = mass @ (change / unit)
        s[:, 1 + n : 1 + 2 * n, n : 2 * n] = (mass * wide) @ mass.T
        s[:, 1 + 2 * n :, 2 * n :] = np.diag(variance)
        s[0, 1 + 2 * n :, 2 * n :] = np.diag(self.free) / (2.0 * self.decay)
        self.w[:] = contact / (self.filters - 1)
        self.w[0] = 1.0 - contact
        self.log_odds = log(contact)
        self.mean[...] = s[0, 0].reshape(3, n)
        self.covariance[...] = s[0, 1 + 2 * n :, 2 * n :]

    def shift(self, torque):
        """Take `torque` (n,) out of d of all filters: what is now known."""
        np.asarray(self.s)[:, 0, 2 * self.joints :] -= torque
        self.mean[2] -= torque

    def step(
        self, double h, const double[:, :] mass, const double[::1] change, double vague,
        const double[::1] drive, const double[:, ::1] shape,
    ):
        """
        Go on to the next sample.

        Parameters
        ----------
        h : float
            Time since the one before, s.
        mass : (n, n) array
            M at this sample.
        change : (n,) array
            q - q before, so that Y has changed by M times that; or qd, where p is measured.
        vague : float
            Share of `change` that is not known, the same for all joints.
        drive : (n,) array
            u at this sample: torque + C^T qd - g.
        shape : (n, n) array
            Sum of J^T J over the links, by their shares: how forces act on the joints.

        """
        cdef int i, j, k, n = self.joints
        cdef const double[::1] variance = self.variance[1 if self.of_position else 2]
        if not (
            n == mass.shape[0] == mass.shape[1] == change.shape[0] == drive.shape[0]
            == shape.shape[0] == shape.shape[1]
        ):
            raise ValueError(f'expected arrays of {n} joints')
        for i in range(n):
            self.mean_drive[i] = 0.5 * (self.drive[i] + drive[i])
            self.drive[i] = drive[i]
            self.measured[i] = 0.0
            for k in range(n):
                # Y has changed by the mean M, while p is by that of now.
                self.middle[i, k] = mass[i, k]
                if self.of_position:
                    self.middle[i, k] = 0.5 * (self.mass[i, k] + mass[i, k])
                self.mass[i, k] = mass[i, k]
                self.measured[i] += self.middle[i, k] * change[k]
        for i in range(n):  # M S M' + (vague M v)(vague M v)'
            for j in range(n):
                self.noise[i, j] = vague * self.measured[i] * vague * self.measured[j]
                for k in range(n):
                    self.noise[i, j] += self.middle[i, k] * variance[k] * self.middle[j, k]
        self.mix(h)
        self.predict(h, shape)
        self.correct()
        self.weigh()

    cdef VECTORISED mix(self, double h) noexcept nogil:
        """
        Let each filter begin with a mean over those that it may follow.

        Where contact ends, the torque ends: d begins anew, with what the model does not explain.
        """
        cdef Py_ssize_t j, k, n = self.joints, size = 3 * n, contacts = self.filters - 1
        cdef double begun = -expm1(-self.begin * h) * self.w[0], end = -expm1(-self.end * h)
        cdef double touched = 1.0 - self.w[0], other, stay, share
        cdef double* free = &self.s[0, 0, 0]
        cdef double* contact = &self.s[contacts + 1, 0, 0]
        # Probability that contact goes on with one other intensity.
        other = (1.0 - end) * -expm1(-self.change * h) / fmax(contacts - 1, 1.0)
        stay = 1.0 - end - contacts * other  # by how much likelier the same one is
        self.s[contacts + 1, :, :] = 0.0
        for j in range(contacts + 1):
            # Means become those off that of all, and covariances squares, which can be added.
            add(&self.s[j, 0, 0], -1.0, &self.average[0], 2 * n)
            add_square(&self.s[j, 0, 0], 1.0, size)
            if j > 0:
                add(contact, self.w[j], &self.s[j, 0, 0], size * (size + 1))
        for j in range(1, contacts + 1):
            self.mixed[j] = begun / contacts + other * touched + stay * self.w[j]
            share = 1.0 / self.mixed[j]
            self.anew[j] = begun / contacts * share
            scale(&self.s[j, 0, 0], stay * self.w[j] * share, size * (size + 1))
            add(&self.s[j, 0, 0], other * share, contact, size * (size + 1))
            add(&self.s[j, 0, 0], self.anew[j], free, size * (size + 1))
        self.s[contacts + 1, :, 2 * n :] = 0.0
        self.s[contacts + 1, 2 * n + 1 :, :] = 0.0
        for k in range(n):
            share = touched * self.free[k] / (2.0 * self.decay)
            self.s[contacts + 1, 1 + 2 * n + k, 2 * n + k] = share
        self.mixed[0] = self.w[0] - begun + end * touched
        scale(free, (self.w[0] - begun) / self.mixed[0], size * (size + 1))
        add(free, end / self.mixed[0], contact, size * (size + 1))
        for j in range(contacts + 1):
            add_square(&self.s[j, 0, 0], -1.0, size)
            add(&self.s[j, 0, 0], 1.0, &self.average[0], 2 * n)

    cdef VECTORISED predict(self, double h, const double[:, ::1] shape) noexcept nogil:
        """
        Bring all filters to the time of the sample.

        Where contact has begun, d may have jumped, now or a little earlier.
        """
        cdef Py_ssize_t j, i, a, b, n = self.joints
        cdef double stay, jump, own, contact
        cdef double[3] push  # what a torque within h does to Y, p and d
        cdef double[9] now, earlier  # what white noise of d' within h, and before, does to them
        cdef double* row
        push[:] = [0.5 * h * h, h, 0.0]
        grow(now, h)
        grow(earlier, self.since)
        carry(earlier, 1, h, 1.0)
        for j in range(self.filters):
            stay = 1.0 if j else exp(-self.decay * h)
            jump = self.anew[j] * self.onset / self.since
            advance(&self.s[j, 0, 0], n, h, stay)
            carry(&self.s[j, 1, 0], n, h, stay)
            for a in range(3):
                for i in range(n):
                    self.s[j, 0, a * n + i] += push[a] * self.mean_drive[i]
                    for b in range(3):
                        row = &self.s[j, 1 + a * n + i, b * n]
                        own = push[a] * push[b] * self.variance[0, i]
                        row[i] += own + now[3 * a + b] * self.free[i]
                        contact = self.scales[j] * (now[3 * a + b] + jump * earlier[3 * a + b])
                        add(row, contact, &shape[i, 0], n)

    cdef VECTORISED correct(self) noexcept nogil:
        """Correct all filters by the sample, and write how likely it was to each."""
        cdef Py_ssize_t j, i, k, o, n = self.joints, width = 4 * n + 1
        cdef Py_ssize_t own = 0 if self.of_position else n  # where what is measured begins
        cdef double pivot
        cdef double[:, ::1] p, work = self.work
        for j in range(self.filters):
            p = self.s[j, 1:]
            for i in range(n):
                for k in range(n):
                    work[i, k] = p[own + i, own + k] + self.noise[i, k]
                for k in range(3 * n):
                    work[i, n + k] = p[own + i, k]
                work[i, 4 * n] = self.measured[i] - self.s[j, 0, own + i]
            # Cholesky, S = L L^T, by rows: all columns become L^-1 times themselves.
            self.likelihood[j] = 0.0
            for i in range(n):
                pivot = 1.0 / sqrt(fmax(work[i, i], 1e-300))
                for k in range(width):
                    work[i, k] *= pivot
                for o in range(i + 1, n):
                    add(&work[o, 0], -work[i, o], &work[i, 0], width)
                self.likelihood[j] += log(pivot) - 0.5 * work[i, 4 * n] * work[i, 4 * n]
            for o in range(n):
                add(&self.s[j, 0, 0], work[o, 4 * n], &work[o, n], 3 * n)
            for i in range(3 * n):
                for o in range(n):
                    add(&p[i, 0], -work[o, n + i], &work[o, n], i + 1)
                for k in range(i):  # an asymmetry of rounding would grow with time
                    p[k, i] = p[i, k]
            # Y begins anew at each sample, with what it is more than measured.
            if self.of_position:
                add(&self.s[j, 0, 0], -1.0, &self.measured[0], n)

    cdef VECTORISED weigh(self) noexcept nogil:
        """
        Write the weights, the mean over all filters, and the covariance of d by the likeliest one.

        That of all filters is mostly that of the others, however unlikely: their errors, seldom
        as they are, are the largest by far.
        """
        cdef Py_ssize_t j, i, k, n = self.joints, d = 2 * n, best = 0
        cdef double most = -1e300, total = 0.0, off
        cdef double* x
        for j in range(self.filters):
            most = fmax(most, self.likelihood[j])
        for j in range(self.filters):
            self.w[j] = fmax(self.mixed[j] * exp(self.likelihood[j] - most), SMALLEST)
            total += self.w[j]
        self.average[:] = 0.0
        for j in range(self.filters):
            self.w[j] /= total
            best = j if self.w[j] > self.w[best] else best
            add(&self.average[0], self.w[j], &self.s[j, 0, 0], 3 * n)
        self.log_odds = log(fmax(1.0 - self.w[0], SMALLEST)) - log(self.w[0])
        x = &self.s[best, 0, 0]
        for i in range(d, 3 * n):
            off = x[i] - self.average[i]
            for k in range(n):
                self.spread[i - d, k] = (
                    self.s[best, 1 + i, d + k] + off * (x[d + k] - self.average[d + k])
                )


cdef inline void add(
    double* to, double share, const double* other, Py_ssize_t size
) noexcept nogil:
    """Add a share of so many numbers to others."""
    cdef Py_ssize_t k
    for k in range(size):
        to[k] += share * other[k]


cdef inline void scale(double* to, double share, Py_ssize_t size) noexcept nogil:
    """Multiply so many numbers."""
    cdef Py_ssize_t k
    for k in range(size):
        to[k] *= share


cdef inline void add_square(double* x, double share, Py_ssize_t size) noexcept nogil:
    """Add a share of x x' to the matrix that follows x."""
    cdef Py_ssize_t i
    for i in range(size):
        add(x + (i + 1) * size, share * x[i], x, size)


cdef inline void advance(double* y, Py_ssize_t count, double h, double stay) noexcept nogil:
    """Multiply by the transition: so many numbers that belong to Y, then to p and to d."""
    cdef double* p = y + count
    cdef double* d = p + count
    cdef Py_ssize_t k
    for k in range(count):
        y[k] += h * p[k] + 0.5 * h * h * d[k]
        p[k] += h * d[k]
        d[k] *= stay


cdef inline void carry(double* p, Py_ssize_t n, double h, double stay) noexcept nogil:
    """Multiply a covariance of n joints by the transition from both sides."""
    cdef Py_ssize_t i
    advance(p, 3 * n * n, h, stay)
    for i in range(3 * n):
        advance(p + i * 3 * n, n, h, stay)


cdef void grow(double* p, double t) noexcept nogil:
    """Write the covariance of Y, p and d that white noise of d' makes within t seconds."""
    cdef double t2 = t * t, t3 = t * t * t
    p[0], p[1], p[2] = t2 * t3 / 20.0, t2 * t2 / 8.0, t3 / 6.0
    p[3], p[4], p[5] = p[1], t3 / 3.0, t2 / 2.0
    p[6], p[7], p[8] = p[2], p[5], t
