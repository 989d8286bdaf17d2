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
# Blocks of a covariance: of Y and Y, Y and p, Y and d, p and p, p and d, d and d.
cdef enum:
    YY, YP, YD, PP, PD, DD, BLOCKS


cdef class Bank:
    """
    The filters, their states and weights.

    Parameters
    ----------
    free_intensity : (n,) array
        W of free motion on its diagonal, of each joint: torque^2 / s.
    decay : float
        Of d in free motion, 1/s; in contact d does not decay.
    scales : (m,) array
        Intensities of the contact filters: their W is scale^2 times `shape` of `step`, and that of
        free motion.
    begin, end, change : float
        Rates (1/s) at which contact begins and ends, and at which its intensity changes.
    onset : float
        Seconds of W by which d may have jumped where contact begins: a force that is there at once
        would else be taken for one that still grows, and its estimate overshoots.
    since : float
        Seconds for which it may not have been seen: what it has done to Y and p until then would
        else be taken for more force.
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
    # Means of (t^2 / 2, t, 1)' (t^2 / 2, t, 1) over the times t since d may have jumped.
    cdef double[BLOCKS] begun
    cdef double[::1] free, scales, w, mixed, share, likelihood
    cdef double[:, :, ::1] x, x0
    cdef double[:, :, :, ::1] p, p0
    cdef double[:, ::1] s, gain, average, spread
    cdef double[::1] innovation

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
        self.begun[YY], self.begun[YP], self.begun[YD] = since**4 / 20, since**3 / 8, since**2 / 6
        self.begun[PP], self.begun[PD], self.begun[DD] = since**2 / 3, since / 2, 1.0
        self.x, self.x0 = np.zeros((m, 3, n)), np.zeros((m, 3, n))
        self.p, self.p0 = np.zeros((m, BLOCKS, n, n)), np.zeros((m, BLOCKS, n, n))
        self.s, self.gain, self.innovation = np.zeros((n, n)), np.zeros((n, 3 * n)), np.zeros(n)
        self.weights, self.mean, self.covariance = np.zeros(m), np.zeros((3, n)), np.zeros((n, n))
        self.w, self.average, self.spread = self.weights, self.mean, self.covariance
        self.mixed, self.share, self.likelihood = np.zeros(m), np.zeros(m), np.zeros(m)
        self.start(np.zeros(n), np.zeros((n, n)), np.zeros(n))

    def __reduce__(self):
        given = (
            np.asarray(self.free), self.decay, np.asarray(self.scales), self.begin, self.end,
            self.change, self.onset, self.since, self.of_position,
        )
        return Bank, given, (self.log_odds, self.weights, self.mean, self.covariance,
                             np.asarray(self.x), np.asarray(self.p))

    def __setstate__(self, state):
        self.log_odds = state[0]
        parts = (self.weights, self.mean, self.covariance, np.asarray(self.x), np.asarray(self.p))
        for own, given in zip(parts, state[1:], strict=True):
            own[...] = given

    def start(self, momentum, momentum_covariance, torque_variance):
        """
        Begin in free motion.

        Parameters
        ----------
        momentum : (n,) array
            p = M qd.
        momentum_covariance : (n, n) array
        torque_variance : (n,) array
            Of d at the start.

        """
        cdef int j
        np.asarray(self.x)[...] = 0.0
        np.asarray(self.p)[...] = 0.0
        for j in range(self.filters):
            np.asarray(self.x)[j, 1] = momentum
            np.asarray(self.p)[j, PP] = momentum_covariance
            np.asarray(self.p)[j, DD] = np.diag(torque_variance)
        self.weights[...] = SMALLEST
        self.weights[0] = 1.0
        self.log_odds = log(SMALLEST)
        self.mean[...] = 0.0
        self.mean[1] = momentum
        self.covariance[...] = np.diag(torque_variance)

    def shift(self, torque):
        """Take `torque` (n,) out of d of all filters: what is now known."""
        np.asarray(self.x)[:, 2] -= torque
        self.mean[2] -= torque

    def step(
        self, double h, const double[::1] measured, const double[::1] drive,
        const double[:, ::1] noise, const double[::1] torque_variance, const double[:, ::1] shape,
    ):
        """
        Go on to the next sample.

        Parameters
        ----------
        h : float
            Time since the one before, s.
        measured : (n,) array
            M (q - q before), the increment of Y; or p.
        drive : (n,) array
            u: torque + C^T qd - g.
        noise : (n, n) array
            Covariance of the error of Y; or of p.
        torque_variance : (n,) array
            Of u, from sample to sample.
        shape : (n, n) array
            Sum of J^T J over the links: how forces on the arm act on its joints.

        """
        cdef int n = self.joints
        sizes = {
            measured.shape[0], drive.shape[0], torque_variance.shape[0],
            noise.shape[0], noise.shape[1], shape.shape[0], shape.shape[1],
        }  # fmt: skip
        if sizes != {n}:
            raise ValueError(f'expected arrays of {n} joints, got sizes {sorted(sizes)}')
        with nogil:
            self.mix(h, shape)
            self.predict(h, measured, drive, torque_variance, shape)
            self.correct(measured, noise)
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
        cdef int i, j, a, b, k, o, block, known, n = self.joints, m = self.filters
        cdef double share, c
        cdef double* to
        cdef double* source
        for j in range(m):
            self.mixed[j] = 0.0
            for i in range(m):
                self.share[i] = self.transition(i, j, h) * self.w[i]
                self.mixed[j] += self.share[i]
            for a in range(3):
                for k in range(n):
                    self.x0[j, a, k] = 0.0
            self.p0[j, :, :, :] = 0.0
            for i in range(m):
                self.share[i] /= self.mixed[j]
                for a in range(2 if j == 0 and i > 0 else 3):
                    for k in range(n):
                        self.x0[j, a, k] += self.share[i] * self.x[i, a, k]
            for i in range(m):
                share = self.share[i]
                if share < SMALLEST:
                    continue
                known = 2 if j == 0 and i > 0 else 3
                block = 0
                for a in range(3):
                    for b in range(a, 3):
                        to, source = &self.p0[j, block, 0, 0], &self.p[i, block, 0, 0]
                        for k in range(n):
                            c = (self.x[i, a, k] if a < known else 0.0) - self.x0[j, a, k]
                            c *= share
                            for o in range(n):
                                to[k * n + o] += c * (
                                    (self.x[i, b, o] if b < known else 0.0) - self.x0[j, b, o]
                                )
                                if b < known:
                                    to[k * n + o] += share * source[k * n + o]
                            if a >= known:
                                to[k * n + k] += share * self.free[k] / (2.0 * self.decay)
                        block += 1
                if j > 0 and i == 0:
                    c = share * self.onset * self.scales[j - 1] * self.scales[j - 1]
                    for block in range(BLOCKS):
                        for k in range(n):
                            for o in range(n):
                                self.p0[j, block, k, o] += c * self.begun[block] * shape[k, o]

    cdef void predict(
        self, double h, const double[::1] measured, const double[::1] drive,
        const double[::1] torque_variance, const double[:, ::1] shape,
    ) noexcept nogil:
        """Bring all filters to the time of the sample; Y becomes what it is more than measured."""
        cdef int j, i, k, n = self.joints
        cdef double rate, stay, to_p, to_y, scale, w, e
        cdef double ayy, ayp, ayd, app, apd
        cdef double[:, :, ::1] p
        cdef double[:, :, ::1] q
        for j in range(self.filters):
            rate = 0.0 if j else self.decay
            scale = self.scales[j - 1] * self.scales[j - 1] if j else 0.0
            stay = exp(-rate * h)
            to_p = -expm1(-rate * h) / rate if rate > 0.0 else h
            # The difference is of two nearly equal numbers where the decay is slow.
            to_y = (h - to_p) / rate if rate * h > 1e-4 else h * h * (0.5 - rate * h / 6.0)
            for k in range(n):
                self.x[j, 0, k] = self.x0[j, 0, k] + h * self.x0[j, 1, k]
                self.x[j, 0, k] += to_y * self.x0[j, 2, k] + 0.5 * h * h * drive[k]
                if self.of_position:
                    self.x[j, 0, k] -= measured[k]
                self.x[j, 1, k] = self.x0[j, 1, k] + to_p * self.x0[j, 2, k] + h * drive[k]
                self.x[j, 2, k] = stay * self.x0[j, 2, k]
            p, q = self.p0[j], self.p[j]
            for i in range(n):
                for k in range(n):
                    ayy = p[YY, i, k] + h * p[YP, k, i] + to_y * p[YD, k, i]
                    ayp = p[YP, i, k] + h * p[PP, i, k] + to_y * p[PD, k, i]
                    ayd = p[YD, i, k] + h * p[PD, i, k] + to_y * p[DD, i, k]
                    app = p[PP, i, k] + to_p * p[PD, k, i]
                    apd = p[PD, i, k] + to_p * p[DD, i, k]
                    w = scale * shape[i, k] + (self.free[i] if i == k else 0.0)
                    e = torque_variance[i] if i == k else 0.0
                    q[YY, i, k] = ayy + h * ayp + to_y * ayd
                    q[YY, i, k] += 0.25 * h ** 4 * e + h ** 5 / 20.0 * w
                    q[YP, i, k] = ayp + to_p * ayd + 0.5 * h ** 3 * e + h ** 4 / 8.0 * w
                    q[YD, i, k] = stay * ayd + h ** 3 / 6.0 * w
                    q[PP, i, k] = app + to_p * apd + h * h * e + h ** 3 / 3.0 * w
                    q[PD, i, k] = stay * apd + 0.5 * h * h * w
                    q[DD, i, k] = stay * stay * p[DD, i, k] + h * w

    cdef void correct(self, const double[::1] measured, const double[:, ::1] noise) noexcept nogil:
        """Correct all filters by the sample, and weigh them by how likely it was to each."""
        cdef int j, i, k, o, a, b, block, n = self.joints
        cdef int of = 0 if self.of_position else 1
        cdef int own = YY if self.of_position else PP
        cdef double total, most = -1e300, pivot
        cdef double[:, :, ::1] p
        for j in range(self.filters):
            p = self.p[j]
            for i in range(n):
                self.innovation[i] = -self.x[j, of, i]
                if not self.of_position:
                    self.innovation[i] += measured[i]
                for k in range(n):
                    self.s[i, k] = p[own, i, k] + noise[i, k]
                    if self.of_position:  # gain: covariance of the sample with Y, p and d
                        self.gain[i, k] = p[YY, i, k]
                        self.gain[i, n + k] = p[YP, i, k]
                        self.gain[i, 2 * n + k] = p[YD, i, k]
                    else:
                        self.gain[i, k] = p[YP, k, i]
                        self.gain[i, n + k] = p[PP, i, k]
                        self.gain[i, 2 * n + k] = p[PD, i, k]
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
            for o in range(n):
                for a in range(3):
                    for k in range(n):
                        self.x[j, a, k] += self.gain[o, a * n + k] * self.innovation[o]
                block = 0
                for a in range(3):
                    for b in range(a, 3):
                        for i in range(n):
                            pivot = self.gain[o, a * n + i]
                            for k in range(n):
                                p[block, i, k] -= pivot * self.gain[o, b * n + k]
                        block += 1
            if not self.of_position:
                for k in range(n):
                    self.x[j, 0, k] = 0.0
                p[YY, :, :] = 0.0
                p[YP, :, :] = 0.0
                p[YD, :, :] = 0.0
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
        cdef int j, a, i, k, n = self.joints
        cdef bint free = self.w[0] > 0.5
        cdef double off, share, all_of_them = self.w[0] if free else 1.0 - self.w[0]
        for a in range(3):
            for k in range(n):
                self.average[a, k] = 0.0
                for j in range(self.filters):
                    self.average[a, k] += self.w[j] * self.x[j, a, k]
        for i in range(n):
            for k in range(n):
                self.spread[i, k] = 0.0
        for j in range(0 if free else 1, 1 if free else self.filters):
            share = self.w[j] / all_of_them
            for i in range(n):
                off = self.x[j, 2, i] - self.average[2, i]
                for k in range(n):
                    self.spread[i, k] += share * (
                        self.p[j, DD, i, k] + off * (self.x[j, 2, k] - self.average[2, k])
                    )
