# SPDX-License-Identifier: Apache-2.0
"""
Interacting filters over all joints of an arm: one for free motion, the others for contact.

Each filter has the state Y, p, d of every joint (docs/arm.md):

    Y' = p,   p' = u + d,   d' = -decay d + white noise of intensity W

and so all joints share one transition; only their covariances are coupled. The filters differ in
decay and W. They interact as in H. Blom and Y. Bar-Shalom, IEEE Transactions on Automatic Control
33(8), 1988, doi:10.1109/9.1299.
"""

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
    begin, end, change : float
        Rates (1/s) at which contact begins and ends, and at which its intensity changes.
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
    cdef readonly object mean  # (3, n): Y less what was measured, p and d
    cdef readonly object covariance  # (n, n) of d, if the likelier of both is right
    cdef readonly object weights  # (m + 1,), the first of free motion
    cdef double decay, begin, end, change, onset, since
    cdef double[::1] free, scales, w, mixed, share, likelihood, average
    cdef double[::1] off, innovation, measured
    # Of each filter: Y of all joints, p of all, d of all, and their covariance; now and before.
    cdef double[:, ::1] x, x0
    cdef double[:, :, ::1] p, p0
    cdef double[:, ::1] s, gain, spread, noise

    def __init__(
        self, free_intensity, double decay, scales, double begin, double end, double change,
        double onset=0.0, double since=0.0, bint of_position=True,
    ):
        cdef int n = len(free_intensity), m = len(scales) + 1
        self.joints, self.filters, self.of_position = n, m, of_position
        self.free = np.array(free_intensity, dtype=np.float64)
        self.scales = np.array(scales, dtype=np.float64)
        self.decay, self.begin, self.end, self.change = decay, begin, end, change
        self.onset, self.since = onset, since
        self.x, self.x0 = np.zeros((m, 3 * n)), np.zeros((m, 3 * n))
        self.p, self.p0 = np.zeros((m, 3 * n, 3 * n)), np.zeros((m, 3 * n, 3 * n))
        self.s, self.gain = np.zeros((n, n)), np.zeros((n, 3 * n))
        self.off, self.innovation = np.zeros(3 * n), np.zeros(n)
        self.measured, self.noise = np.zeros(n), np.zeros((n, n))
        self.weights, self.mean, self.covariance = np.zeros(m), np.zeros((3, n)), np.zeros((n, n))
        self.w, self.average, self.spread = self.weights, self.mean.reshape(-1), self.covariance
        self.mixed, self.share, self.likelihood = np.zeros(m), np.zeros(m), np.zeros(m)
        self.start(np.zeros(n), np.zeros((n, n)), np.zeros(n))

    def start(self, momentum, momentum_covariance, torque_variance):
        """Begin in free motion with p = M qd (n,), its covariance, and the variance of d (n,)."""
        cdef int n = self.joints
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
            M.
        change : (n,) array
            q - q before, so that Y has changed by M times that; or qd, where p is measured.
        variance : (n,) array
            Of the noise of `change`.
        vague : float
            Share of `change` that is not known, the same for all joints.
        drive : (n,) array
            u: torque + C^T qd - g.
        torque_variance : (n,) array
            Of u, from sample to sample.
        shape : (n, n) array
            Sum of J^T J over the links: how forces on the arm act on its joints.

        """
        cdef int n = self.joints
        if not (
            n == mass.shape[0] == mass.shape[1] == change.shape[0] == variance.shape[0]
            == drive.shape[0] == torque_variance.shape[0] == shape.shape[0] == shape.shape[1]
        ):
            raise ValueError(f'expected arrays of {n} joints')
        self.x, self.x0, self.p, self.p0 = self.x0, self.x, self.p0, self.p
        with nogil:
            self.mix(h, shape)
            self.predict(h, drive, torque_variance, shape)
            self.measure(mass, change, variance, vague)
            self.correct()
            self.combine()

    cdef double transition(self, int i, int j, double h) noexcept nogil:
        """Return the probability that filter j follows filter i within h."""
        cdef int contacts = self.filters - 1
        cdef double begin = -expm1(-self.begin * h), end = -expm1(-self.end * h)
        cdef double change = -expm1(-self.change * h) if contacts > 1 else 0.0
        if i == 0:
            return 1.0 - begin if j == 0 else begin / contacts
        if j == 0:
            return end
        return (1.0 - end) * (1.0 - change if i == j else change / (contacts - 1))

    cdef void mix(self, double h, const double[:, ::1] shape) noexcept nogil:
        """
        Write what each filter begins with: a mean over those that it may follow.

        Where contact ends, the torque ends: d begins anew, with what the model does not explain.
        Where it begins, d may have jumped, now or a little earlier.
        """
        cdef int i, j, a, b, n = self.joints, m = self.filters
        cdef double share, c, since = fmax(self.since, 1e-15)
        cdef double* to
        cdef double* source
        for j in range(m - 1, -1, -1):
            self.mixed[j] = 0.0
            for i in range(m):
                self.share[i] = self.transition(i, j, h) * self.w[i]
                self.mixed[j] += self.share[i]
                if j == 0 and i > 0:  # nobody needs the others' d any more
                    self.x0[i, 2 * n :] = 0.0
                    self.p0[i, :, 2 * n :] = 0.0
                    self.p0[i, 2 * n :, :] = 0.0
                    for a in range(n):
                        self.p0[i, 2 * n + a, 2 * n + a] = self.free[a] / (2.0 * self.decay)
            self.x[j, :] = 0.0
            self.p[j, :, :] = 0.0
            for i in range(m):
                self.share[i] /= self.mixed[j]
                for a in range(3 * n):
                    self.x[j, a] += self.share[i] * self.x0[i, a]
            for i in range(m):
                share = self.share[i]
                if share < SMALLEST:
                    continue
                for a in range(3 * n):
                    self.off[a] = self.x0[i, a] - self.x[j, a]
                for a in range(3 * n):
                    c = share * self.off[a]
                    to, source = &self.p[j, a, 0], &self.p0[i, a, 0]
                    for b in range(3 * n):
                        to[b] += share * source[b] + c * self.off[b]
            if j > 0:  # a jump at any time since then
                c = self.share[0] * self.onset * self.scales[j - 1] * self.scales[j - 1]
                diffuse(self.p[j], since, c / since, shape)

    cdef void predict(
        self, double h, const double[::1] drive, const double[::1] torque_variance,
        const double[:, ::1] shape,
    ) noexcept nogil:
        """Bring all filters to the time of the sample."""
        cdef int j, i, k, n = self.joints
        cdef double rate, stay, to_p, to_y, scale, e
        cdef double[:, ::1] p
        for j in range(self.filters):
            rate = 0.0 if j else self.decay
            scale = self.scales[j - 1] * self.scales[j - 1] if j else 0.0
            stay = exp(-rate * h)
            to_p = -expm1(-rate * h) / rate if rate > 0.0 else h
            # The difference is of two nearly equal numbers where the decay is slow.
            to_y = (h - to_p) / rate if rate * h > 1e-4 else h * h * (0.5 - rate * h / 6.0)
            p = self.p[j]
            advance(&self.x[j, 0], n, h, to_y, to_p, stay)
            advance(&p[0, 0], 3 * n * n, h, to_y, to_p, stay)
            for i in range(3 * n):
                advance(&p[i, 0], n, h, to_y, to_p, stay)
            for i in range(n):
                self.x[j, i] += 0.5 * h * h * drive[i]
                self.x[j, n + i] += h * drive[i]
                e = h * h * torque_variance[i]
                p[i, i] += 0.25 * h * h * e
                p[i, n + i] += 0.5 * h * e
                p[n + i, i] += 0.5 * h * e
                p[n + i, n + i] += e
                for k in range(n):
                    self.s[i, k] = scale * shape[i, k]
                self.s[i, i] += self.free[i]
            diffuse(p, h, 1.0, self.s)

    cdef void measure(
        self, const double[:, ::1] mass, const double[::1] change, const double[::1] variance,
        double vague,
    ) noexcept nogil:
        """Write M v and the covariance of its error, M S M' + (vague M v)(vague M v)'."""
        cdef int i, j, k, n = self.joints
        for i in range(n):
            self.measured[i] = 0.0
            for k in range(n):
                self.measured[i] += mass[i, k] * change[k]
        for i in range(n):
            for j in range(n):
                self.noise[i, j] = vague * self.measured[i] * vague * self.measured[j]
                for k in range(n):
                    self.noise[i, j] += mass[i, k] * variance[k] * mass[j, k]

    cdef void correct(self) noexcept nogil:
        """Correct all filters by the sample, and weigh them by how likely it was to each."""
        cdef int j, i, k, o, n = self.joints
        cdef int own = 0 if self.of_position else n  # where the measured part of the state is
        cdef double total, most = -1e300, pivot
        cdef double* row
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
                for o in range(i):
                    for k in range(i, n):
                        self.s[k, i] -= self.s[k, o] * self.s[i, o]
                pivot = sqrt(fmax(self.s[i, i], 1e-300))
                total -= log(pivot)
                for k in range(i, n):
                    self.s[k, i] /= pivot
                for o in range(i):
                    self.innovation[i] -= self.s[i, o] * self.innovation[o]
                    for k in range(3 * n):
                        self.gain[i, k] -= self.s[i, o] * self.gain[o, k]
                self.innovation[i] /= pivot
                for k in range(3 * n):
                    self.gain[i, k] /= pivot
                total -= 0.5 * self.innovation[i] * self.innovation[i]
            self.likelihood[j] = total
            most = fmax(most, total)
            for i in range(3 * n):
                row = &p[i, 0]
                for o in range(n):
                    pivot = self.gain[o, i]
                    self.x[j, i] += pivot * self.innovation[o]
                    for k in range(i + 1):
                        row[k] -= pivot * self.gain[o, k]
                for k in range(i):  # an asymmetry of rounding would grow with time
                    p[k, i] = row[k]
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

    cdef void combine(self) noexcept nogil:
        """
        Write the mean over all filters, and the covariance of d.

        The covariance is that of the likelier of free motion and contact: the other one, however
        unlikely, would make a band of two thirds as wide as a force that is not there.
        """
        cdef int j, i, k, n = self.joints
        cdef bint free = self.w[0] > 0.5
        cdef double off, share, all_of_them = self.w[0] if free else 1.0 - self.w[0]
        self.average[:] = 0.0
        for j in range(self.filters):
            for k in range(3 * n):
                self.average[k] += self.w[j] * self.x[j, k]
        self.spread[:, :] = 0.0
        for j in range(0 if free else 1, 1 if free else self.filters):
            share = self.w[j] / all_of_them
            for i in range(2 * n, 3 * n):
                off = self.x[j, i] - self.average[i]
                for k in range(2 * n, 3 * n):
                    self.spread[i - 2 * n, k - 2 * n] += share * (
                        self.p[j, i, k] + off * (self.x[j, k] - self.average[k])
                    )


cdef void advance(
    double* y, int count, double h, double to_y, double to_p, double stay
) noexcept nogil:
    """Multiply by the transition: so many numbers that belong to Y, then to p and to d."""
    cdef double* p = y + count
    cdef double* d = p + count
    cdef int k
    for k in range(count):
        y[k] += h * p[k] + to_y * d[k]
        p[k] += to_p * d[k]
        d[k] *= stay


cdef void diffuse(
    double[:, ::1] p, double t, double intensity, const double[:, ::1] shape
) noexcept nogil:
    """Add the covariance of Y, p and d that white noise of d' makes within t seconds."""
    cdef int a, b, i, k, _, n = shape.shape[0]
    cdef double c
    for a in range(3):
        for b in range(3):
            c = intensity / ((5 - a - b) * (2 if a == 0 else 1) * (2 if b == 0 else 1))
            for _ in range(5 - a - b):
                c *= t
            for i in range(n):
                for k in range(n):
                    p[a * n + i, b * n + k] += c * shape[i, k]
