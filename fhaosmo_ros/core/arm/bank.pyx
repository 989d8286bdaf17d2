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
    onset, since : float
        Where contact begins, d may have jumped by so many seconds of W, at any time within the
        last `since` seconds: else a force that is there at once would be taken for one that still
        grows, and what it has done to Y and p until it is seen for more force.
    of_position : bool
        True if Y is measured, False if p is.

    """

    cdef readonly int joints, filters
    cdef readonly bint of_position
    cdef readonly double log_odds  # of contact against free motion
    cdef readonly object motion  # (n,): M times `change` of the latest step
    cdef readonly object mean  # (3, n): Y less what was measured, p and d
    cdef readonly object covariance  # (n, n) of d, if the likeliest filter is right
    cdef readonly object weights  # (m + 1,), the first of free motion
    cdef double decay, begin, end, change, onset, since
    cdef double[::1] free, scales, w, mixed, begun, likelihood, average
    cdef double[::1] off, innovation, measured
    # Of each filter: Y of all joints, p of all, d of all, and their covariance.
    cdef double[:, ::1] x
    cdef double[:, :, ::1] p
    # The same, summed over all filters and over those of contact, as means off that of all.
    cdef double[:, ::1] sum_x
    cdef double[:, :, ::1] sum_p
    cdef double[:, ::1] s, gain, spread, noise
    # M and u at the sample before, and between it and the next one.
    cdef double[:, ::1] mass, middle
    cdef double[::1] drive, mean_drive

    def __cinit__(
        self, free_intensity, double decay, scales, rates, double onset=0.0, double since=0.0,
        bint of_position=True,
    ):
        cdef int n = len(free_intensity), m = len(scales) + 1
        self.joints, self.filters, self.of_position = n, m, of_position
        self.free = np.array(free_intensity, dtype=np.float64)
        self.scales = np.array(scales, dtype=np.float64)
        self.decay, (self.begin, self.end, self.change) = decay, rates
        self.onset, self.since = onset, since
        self.x, self.p = np.zeros((m, 3 * n)), np.zeros((m, 3 * n, 3 * n))
        self.sum_x, self.sum_p = np.zeros((2, 3 * n)), np.zeros((2, 3 * n, 3 * n))
        self.s, self.gain = np.zeros((n, n)), np.zeros((n, 3 * n))
        self.off, self.innovation = np.zeros(3 * n), np.zeros(n)
        self.motion, self.noise = np.zeros(n), np.zeros((n, n))
        self.measured = self.motion
        self.weights, self.mean, self.covariance = np.zeros(m), np.zeros((3, n)), np.zeros((n, n))
        self.w, self.average, self.spread = self.weights, self.mean.reshape(-1), self.covariance
        self.mixed, self.begun, self.likelihood = np.zeros(m), np.zeros(m), np.zeros(m)
        self.mass, self.middle = np.zeros((n, n)), np.zeros((n, n))
        self.drive, self.mean_drive = np.zeros(n), np.zeros(n)
        self.start(0.0, 0.0, np.zeros(n), np.zeros((n, n)), np.zeros(n))

    def start(self, mass, drive, momentum, momentum_covariance, torque_variance):
        """
        Begin in free motion.

        With M (n, n) and u (n,) of the first sample, p = M qd (n,) and its covariance (n, n), and
        the variance of d (n,).
        """
        cdef int n = self.joints
        np.asarray(self.mass)[...], np.asarray(self.drive)[...] = mass, drive
        x, p = np.asarray(self.x), np.asarray(self.p)
        x[...], p[...] = 0.0, 0.0
        x[:, n : 2 * n] = momentum
        p[:, n : 2 * n, n : 2 * n] = momentum_covariance
        p[:, 2 * n :, 2 * n :] = np.diag(torque_variance)
        self.weights[...] = SMALLEST
        self.weights[0] = 1.0
        self.log_odds = log(SMALLEST)
        self.mean[...] = x[0].reshape(3, n)
        self.covariance[...] = p[0, 2 * n :, 2 * n :]

    def shift(self, torque):
        """Take `torque` (n,) out of d of all filters: what is now known."""
        np.asarray(self.x)[:, 2 * self.joints :] -= torque
        self.mean[2] -= torque

    def step(
        self, double h, const double[:, ::1] mass, const double[::1] change,
        const double[::1] variance, double vague, const double[::1] drive,
        const double[::1] torque_variance, const double[:, ::1] shape,
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
        variance : (n,) array
            Of the noise of `change`.
        vague : float
            Share of `change` that is not known, the same for all joints.
        drive : (n,) array
            u at this sample: torque + C^T qd - g.
        torque_variance : (n,) array
            Of u, from sample to sample.
        shape : (n, n) array
            Sum of J^T J over the links, by their shares: how forces act on the joints.

        """
        cdef int i, k, n = self.joints
        if not (
            n == mass.shape[0] == mass.shape[1] == change.shape[0] == variance.shape[0]
            == drive.shape[0] == torque_variance.shape[0] == shape.shape[0] == shape.shape[1]
        ):
            raise ValueError(f'expected arrays of {n} joints')
        for i in range(n):
            self.mean_drive[i] = 0.5 * (self.drive[i] + drive[i])
            self.drive[i] = drive[i]
            for k in range(n):
                # Y has changed by the mean M, while p is by that of now.
                self.middle[i, k] = mass[i, k]
                if self.of_position:
                    self.middle[i, k] = 0.5 * (self.mass[i, k] + mass[i, k])
                self.mass[i, k] = mass[i, k]
        with nogil:
            self.mix(h)
            self.predict(h, torque_variance, shape)
            self.measure(change, variance, vague)
            self.correct()
            self.combine()

    cdef VECTORISED mix(self, double h) noexcept nogil:
        """
        Write what each filter begins with: a mean over those that it may follow.

        Where contact ends, the torque ends: d begins anew, with what the model does not explain.
        """
        cdef Py_ssize_t j, a, k, n = self.joints, size = 3 * n, contacts = self.filters - 1
        cdef double begin = -expm1(-self.begin * h) / contacts, end = -expm1(-self.end * h)
        cdef double other = 0.0  # probability that contact goes on with one other intensity
        cdef double touched = 1.0 - self.w[0], stay, share
        cdef double* all_x = &self.sum_x[0, 0]
        cdef double* all_p = &self.sum_p[0, 0, 0]
        cdef double* contact_x = &self.sum_x[1, 0]
        cdef double* contact_p = &self.sum_p[1, 0, 0]
        if contacts > 1:
            other = (1.0 - end) * -expm1(-self.change * h) / (contacts - 1)
        stay = 1.0 - end - contacts * other  # by how much likelier the same one is
        self.sum_x[:, :] = 0.0
        self.sum_p[:, :, :] = 0.0
        for j in range(contacts + 1):
            for a in range(size):
                self.x[j, a] -= self.average[a]
            if j > 0:
                add(contact_x, contact_p, self.w[j], &self.x[j, 0], &self.p[j, 0, 0], size)
        # All filters of contact follow these alike, and themselves more.
        for a in range(size):
            all_x[a] = other * contact_x[a]
        for a in range(size * size):
            all_p[a] = other * contact_p[a]
        add(all_x, all_p, begin * self.w[0], &self.x[0, 0], &self.p[0, 0, 0], size)
        for j in range(1, contacts + 1):
            self.mixed[j] = begin * self.w[0] + other * touched + stay * self.w[j]
            share = 1.0 / self.mixed[j]
            blend(
                &self.x[j, 0], &self.p[j, 0, 0], stay * self.w[j] * share, all_x, all_p, share,
                &self.off[0], size,
            )  # fmt: skip
            self.begun[j] = begin * self.w[0] * share
        for k in range(n):  # of contact that has ended nobody needs d any more
            for a in range(2 * n):
                self.sum_p[1, a, 2 * n + k] = -self.average[2 * n + k] * contact_x[a]
                self.sum_p[1, 2 * n + k, a] = self.sum_p[1, a, 2 * n + k]
            for a in range(n):
                self.sum_p[1, 2 * n + a, 2 * n + k] = (
                    touched * self.average[2 * n + a] * self.average[2 * n + k]
                )
            self.sum_p[1, 2 * n + k, 2 * n + k] += touched * self.free[k] / (2.0 * self.decay)
            contact_x[2 * n + k] = -touched * self.average[2 * n + k]
        stay = (1.0 - contacts * begin) * self.w[0]
        self.mixed[0] = stay + end * touched
        blend(
            &self.x[0, 0], &self.p[0, 0, 0], stay / self.mixed[0], contact_x, contact_p,
            end / self.mixed[0], &self.off[0], size,
        )  # fmt: skip
        for j in range(contacts + 1):
            for a in range(size):
                self.x[j, a] += self.average[a]

    cdef VECTORISED predict(
        self, double h, const double[::1] torque_variance, const double[:, ::1] shape
    ) noexcept nogil:
        """
        Bring all filters to the time of the sample.

        Where contact has begun, d may have jumped, now or a little earlier.
        """
        cdef Py_ssize_t j, i, k, a, b, n = self.joints
        cdef double rate, stay, to_p, to_y, scale, e, since = fmax(self.since, 1e-15)
        cdef double[9] free, contact  # of Y, p and d: how much of `free` and of `shape`
        cdef double* row
        cdef double* p
        free[:] = [0.0] * 9
        grow(free, h, 1.0)
        for j in range(self.filters):
            rate = 0.0 if j else self.decay
            scale = self.scales[j - 1] * self.scales[j - 1] if j else 0.0
            stay = exp(-rate * h)
            to_p = -expm1(-rate * h) / rate if rate > 0.0 else h
            # The difference is of two nearly equal numbers where the decay is slow.
            to_y = (h - to_p) / rate if rate * h > 1e-4 else h * h * (0.5 - rate * h / 6.0)
            p = &self.p[j, 0, 0]
            advance(&self.x[j, 0], n, h, to_y, to_p, stay)
            carry(p, n, h, to_y, to_p, stay)
            contact[:] = [0.0] * 9
            grow(contact, since, scale * self.begun[j] * self.onset / since)
            carry(contact, 1, h, to_y, to_p, stay)
            grow(contact, h, scale)
            for i in range(n):
                self.x[j, i] += 0.5 * h * h * self.mean_drive[i]
                self.x[j, n + i] += h * self.mean_drive[i]
                for a in range(3):
                    for b in range(3):
                        row = p + (a * n + i) * 3 * n + b * n
                        row[i] += free[3 * a + b] * self.free[i]
                        for k in range(n):
                            row[k] += contact[3 * a + b] * shape[i, k]
                e = h * h * torque_variance[i]
                row = p + i * 3 * n
                row[i] += 0.25 * h * h * e
                row[n + i] += 0.5 * h * e
                row = p + (n + i) * 3 * n
                row[i] += 0.5 * h * e
                row[n + i] += e

    cdef VECTORISED measure(
        self, const double[::1] change, const double[::1] variance, double vague
    ) noexcept nogil:
        """Write M v and the covariance of its error, M S M' + (vague M v)(vague M v)'."""
        cdef Py_ssize_t i, j, k, n = self.joints
        cdef double[:, ::1] mass = self.middle
        for i in range(n):
            self.measured[i] = 0.0
            for k in range(n):
                self.measured[i] += mass[i, k] * change[k]
        for i in range(n):
            for j in range(n):
                self.noise[i, j] = vague * self.measured[i] * vague * self.measured[j]
                for k in range(n):
                    self.noise[i, j] += mass[i, k] * variance[k] * mass[j, k]

    cdef VECTORISED correct(self) noexcept nogil:
        """Correct all filters by the sample, and weigh them by how likely it was to each."""
        cdef Py_ssize_t j, i, k, o, n = self.joints
        cdef Py_ssize_t own = 0 if self.of_position else n  # where what is measured begins
        cdef double total, most = -1e300, pivot
        cdef double* row
        cdef double* to
        cdef double[:, ::1] p
        for j in range(self.filters):
            p = self.p[j]
            for i in range(n):
                self.innovation[i] = self.measured[i] - self.x[j, own + i]
                for k in range(n):
                    self.s[i, k] = p[own + i, own + k] + self.noise[i, k]
                for k in range(3 * n):
                    self.gain[i, k] = p[own + i, k]
            # Cholesky: s = L L^T; gain and innovation become L^-1 times themselves.
            total = 0.0
            for i in range(n):
                to = &self.gain[i, 0]
                for o in range(i):
                    pivot = self.s[i, o]
                    row = &self.gain[o, 0]
                    self.innovation[i] -= pivot * self.innovation[o]
                    for k in range(i, n):
                        self.s[k, i] -= self.s[k, o] * pivot
                    for k in range(3 * n):
                        to[k] -= pivot * row[k]
                pivot = 1.0 / sqrt(fmax(self.s[i, i], 1e-300))
                total += log(pivot)
                self.innovation[i] *= pivot
                for k in range(i, n):
                    self.s[k, i] *= pivot
                for k in range(3 * n):
                    to[k] *= pivot
                total -= 0.5 * self.innovation[i] * self.innovation[i]
            self.likelihood[j] = total
            most = fmax(most, total)
            for i in range(3 * n):
                to = &p[i, 0]
                for o in range(n):
                    pivot = self.gain[o, i]
                    row = &self.gain[o, 0]
                    self.x[j, i] += pivot * self.innovation[o]
                    for k in range(i + 1):
                        to[k] -= pivot * row[k]
                for k in range(i):  # an asymmetry of rounding would grow with time
                    p[k, i] = to[k]
            # Y begins anew at each sample, of positions with what it is more than measured.
            for i in range(n):
                self.x[j, i] = self.x[j, i] - self.measured[i] if self.of_position else 0.0
            if not self.of_position:
                p[:n, :] = 0.0
                p[:, :n] = 0.0
        total = 0.0
        for j in range(self.filters):
            self.w[j] = fmax(self.mixed[j] * exp(self.likelihood[j] - most), SMALLEST)
            total += self.w[j]
        for j in range(self.filters):
            self.w[j] /= total
        self.log_odds = log(fmax(1.0 - self.w[0], SMALLEST)) - log(self.w[0])

    cdef VECTORISED combine(self) noexcept nogil:
        """
        Write the mean over all filters, and the covariance of d about it by the likeliest one.

        That of all filters is mostly that of the others, however unlikely: their errors, seldom
        as they are, are the largest by far.
        """
        cdef Py_ssize_t j, i, k, n = self.joints, best = 0
        cdef double* off = &self.off[2 * n]
        self.average[:] = 0.0
        for j in range(self.filters):
            for k in range(3 * n):
                self.average[k] += self.w[j] * self.x[j, k]
        for j in range(self.filters):
            if self.w[j] > self.w[best]:
                best = j
        for i in range(n):
            off[i] = self.x[best, 2 * n + i] - self.average[2 * n + i]
        for i in range(n):
            for k in range(n):
                self.spread[i, k] = self.p[best, 2 * n + i, 2 * n + k] + off[i] * off[k]


cdef inline void add(
    double* x, double* p, double share, const double* of_x, const double* of_p, Py_ssize_t size
) noexcept nogil:
    """Add a share of a filter, its mean and covariance, to a sum of means and of squares."""
    cdef Py_ssize_t a, b
    cdef double c
    for a in range(size):
        c = share * of_x[a]
        x[a] += c
        for b in range(size):
            p[a * size + b] += share * of_p[a * size + b] + c * of_x[b]


cdef inline void blend(
    double* x, double* p, double own, const double* of_x, const double* of_p, double share,
    double* mean, Py_ssize_t size,
) noexcept nogil:
    """Make x and p the mean and covariance of shares of what they have been, and of sums."""
    cdef Py_ssize_t a, b
    cdef double c
    for a in range(size):
        mean[a] = share * of_x[a] + own * x[a]
    for a in range(size):
        c = own * x[a]
        for b in range(size):
            p[a * size + b] = (
                share * of_p[a * size + b] + own * p[a * size + b] + c * x[b] - mean[a] * mean[b]
            )
    for a in range(size):
        x[a] = mean[a]


cdef inline void advance(
    double* y, Py_ssize_t count, double h, double to_y, double to_p, double stay
) noexcept nogil:
    """Multiply by the transition: so many numbers that belong to Y, then to p and to d."""
    cdef double* p = y + count
    cdef double* d = p + count
    cdef Py_ssize_t k
    for k in range(count):
        y[k] += h * p[k] + to_y * d[k]
        p[k] += to_p * d[k]
        d[k] *= stay


cdef inline void carry(
    double* p, Py_ssize_t n, double h, double to_y, double to_p, double stay
) noexcept nogil:
    """Multiply a covariance of n joints by the transition from both sides."""
    cdef Py_ssize_t i
    advance(p, 3 * n * n, h, to_y, to_p, stay)
    for i in range(3 * n):
        advance(p + i * 3 * n, n, h, to_y, to_p, stay)


cdef void grow(double* p, double t, double intensity) noexcept nogil:
    """Add the covariance of Y, p and d that white noise of d' makes within t seconds."""
    cdef double to_d = intensity * t, t2 = t * t
    p[8] += to_d
    p[7] += to_d * t / 2.0
    p[5] += to_d * t / 2.0
    p[4] += to_d * t2 / 3.0
    p[6] += to_d * t2 / 6.0
    p[2] += to_d * t2 / 6.0
    p[3] += to_d * t2 * t / 8.0
    p[1] += to_d * t2 * t / 8.0
    p[0] += to_d * t2 * t2 / 20.0
