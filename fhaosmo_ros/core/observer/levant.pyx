# SPDX-License-Identifier: Apache-2.0
"""
Levant's arbitrary-order differentiator with the paper's curves and power.

One innovation drives every level: eps = y - z_hat_1; gamma is held. Equations are cited by their
numbers in docs/mathematics.md (D). The internal states mirror the estimates, z_tilde_{i+1} =
z_hat_{i+1}, so that whatever reads a cascade's state reads this one; theta is 0.

Levant 2003, doi:10.1080/0020717031000099029.
"""

from libc.math cimport INFINITY, copysign, exp, fabs, log, log1p, pow, sqrt
from libc.string cimport memcpy

from fhaosmo_ros.core.model.phi cimport Dual
from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.kalman cimport Row, fill
from fhaosmo_ros.core.observer.sliding_mode cimport (
    HUBER, LONG_AGO, NEWTON_STEPS, NEWTON_TOLERANCE, TINY, SlidingMode, doubt_of_noise,
    follow_spread, psi
)
from fhaosmo_ros.core.observer.structure cimport Memory

from fhaosmo_ros.core.observer.configuration import deadbeat_shares

# An interval that differs from the tuned one by at most this part of it needs no other gains.
cdef double NEAR = 0.25
# Gains that differ from the tuned ones by at most this part of them are replaced by them.
cdef double CLOSE = 0.02
# Up to so many times the steady variance of the innovation, their influence is limited (D 21).
cdef double NEARLY_STEADY = 1.5
# So many samples in a row beyond all half-widths widen them.
cdef double SATURATED_SAMPLES = 20.0
# A jump of y contradicts the model if it changes a Phi by more than this part of its size.
cdef double OF_SIZE = 0.25


cdef struct Root:
    double eps  # |eps| >= 0
    double w  # |eps|^(2 gamma / N)
    double s  # of the last level, which is set-valued for sign


cdef class Levant(SlidingMode):
    """Levant's differentiator: one innovation, of the powers of D 11, drives all levels."""

    cdef double widest  # half-width (unit of y); growth begins beyond it (D 22)
    cdef double relaxation  # at which the scale returns to 1 (1/s)
    cdef const double[:, ::1] share  # beta of D 18
    cdef double ratio[MOST_LEVELS]  # factors of the corrections of the levels, P / steady P
    cdef double correction_period  # interval that the gains are tuned for (s); 0: any
    # For scheduled gains (D 20).
    cdef double steady_variance  # of the innovations once P is steady
    cdef Row steady[MOST_LEVELS]  # P of the predictions then
    cdef const double[::1] tuned_over_kalman  # corrections of a small innovation
    cdef const double[::1] next_size  # sizes of z_2 .. z_n, d

    def __cinit__(self, configuration):
        cdef int n = self.levels
        self.widest = INFINITY
        # With larger powers saturated levels find y again by themselves.
        if not self.is_sign and self.gamma_initial < 0.5:
            self.widest = max(configuration.widths)
            speed = (configuration.lambdas[n - 1] / configuration.widths[n - 1]) ** (1.0 / n)
            self.relaxation = speed / 3.0
        self.share = deadbeat_shares(n)
        self.correction_period = configuration.parameters['correction_period']
        self.tuned_over_kalman = configuration.tuned_over_kalman
        self.next_size = configuration.next_sizes
        if self.scheduled:
            fill(self.steady, configuration.steady)
            self.steady_variance = self.steady[0][0] + self.noise_variance

    cdef void restart(self, double y) noexcept nogil:
        cdef Memory* memory = &self.memory
        SlidingMode.restart(self, y)
        memory.saturated = memory.beyond = memory.offset = memory.watched = memory.drift = 0.0
        memory.scale = 1.0

    cdef void follow(self, double y, double h, const double* u) noexcept nogil:
        """Follow the model to the sample `y`, then correct the levels (D 18)."""
        cdef Memory* memory = &self.memory
        cdef Row* p = self.trial_covariance
        cdef int i, n = self.levels
        cdef double period = self.correction_period, variance = self.steady_variance, doubt = 1.0
        cdef double b, change, moved, late = 0.0, most, largest = 1.0
        cdef bint far, holds = memory.settled > 0.0 and fabs(h - period) <= NEAR * period
        cdef bint scheduling = self.scheduled and not holds
        if scheduling:
            if memory.settled > 0.0:
                memcpy(p, self.steady, n * sizeof(Row))
                self.correct_covariance(1.0)
                memory.settled = -LONG_AGO
            doubt = doubt_of_noise(-memory.settled, self.bandwidth(period))
            self.linear.predict(p, h)
            variance = p[0][0] + doubt * doubt * self.noise_variance
        self.predict_levels(h, u)
        for i in range(n):
            self.level[i].z_hat, self.ratio[i] = self.prediction.z[i], 1.0
        if not self.scheduled:
            if period > 0.0:  # not below the mean interval: another rate is no gap
                h = min(h, max(period, memory.period))
            self.correct_levels(y, h)
            return
        b = y - self.level[0].z_hat
        change = self.follow_interval(h)
        if memory.beyond == 0.0:
            moved = self.level[0].z_hat - self.before[0].z_hat
            late = fabs(moved / h * change)
        most = HUBER * follow_spread(memory, b, sqrt(variance), late)
        if variance < NEARLY_STEADY * self.steady_variance:  # a large P counts on all of b
            y = self.level[0].z_hat + min(max(b, -most), most)
        if memory.beyond > 0.0:
            return
        if scheduling:
            far = fabs(h - period) > NEAR * period
            for i in range(n):  # D 20
                if self.steady[0][i] > 0.0:
                    self.ratio[i] = p[0][i] / self.steady[0][i] / (doubt * doubt)
                else:
                    self.ratio[i] = self.ratio[0] / (doubt * doubt)
                largest = max(largest, self.ratio[i])
                far = far or fabs(self.ratio[i] - 1.0) > CLOSE
            for i in range(n):  # from the Kalman filter's gains to the tuned ones
                self.ratio[i] *= pow(self.tuned_over_kalman[i], 1.0 / largest - 1.0)
            self.correct_covariance(doubt)
            memory.settled = memory.settled - h if far else 1.0
        self.correct_levels(y, period)

    cdef void correct_levels(self, double y, double h) noexcept nogil:
        """Turn predicted levels into corrected ones by the solution of D 18."""
        cdef double weight[MOST_LEVELS]  # h^i lambda_i
        cdef double power_of_h[MOST_LEVELS]  # h^i
        cdef double scale = self.memory.scale, power = 1.0, v, share
        cdef double b = (y - self.level[0].z_hat) / scale  # D 22
        cdef int i, j, n = self.levels
        cdef Root root
        power_of_h[0], weight[0] = h, self.ratio[0] * h * self.gains[0].lambda_
        for i in range(1, n):
            power_of_h[i] = power_of_h[i - 1] * h
            weight[i] = self.ratio[0] * power_of_h[i] * self.gains[i].lambda_
        root = self.root(weight, fabs(b), self.memory.gamma)
        for i in range(n - 1, -1, -1):
            v = power * psi(self, i, root.eps).value if root.eps > 0.0 else 0.0
            if i == n - 1:
                v = root.s
            self.level[i].z_tilde = self.gains[i].lambda_ * copysign(v, b)
            power *= root.w
        for i in range(n):
            for j in range(i, n):
                share = scale * self.ratio[i] * power_of_h[j - i] * self.share[j, i]
                self.level[i].z_hat += share * self.level[j].z_tilde
        self.grow(root.eps, h)
        # What the sum above is but for rounding.
        self.level[0].z_hat = y - copysign(scale * root.eps, b)
        for i in range(n):
            self.level[i].z_tilde = self.level[i + 1].z_hat if i + 1 < n else 0.0

    cdef Root root(self, const double* weight, double b, double gamma) noexcept nogil:
        """
        Solve eps + sum_i h^i lambda_i |eps|^{p_i} s_i = b, s_i in psi_i(eps), b >= 0 (D 18).

        Newton's method on the logarithms of both sides over that of eps: there a sum of powers is
        convex and nearly straight, at any gamma and over any range. Powers are those of w, as
        |eps|^{p_i} = w^{N-i}, but eps does not come from w, which tells nothing of it as gamma
        goes to 0. The left side increases with eps.
        """
        cdef int i, _, n = self.levels
        cdef double constant = 0.0, target, q = 2.0 * gamma / n, x, low, high, w = 1.0, e
        cdef double f, slope, power, change, moved
        cdef Dual curve
        if b < TINY:
            return Root(0.0, 0.0, 0.0)
        if self.is_sign:
            constant = weight[n - 1]
            if b <= constant:  # sliding: the set-valued sign takes what is needed
                return Root(0.0, 0.0, b / constant)
        target = b - constant
        x = log(target)  # of eps; the other terms only make it less
        low, high = log(TINY), x
        for _ in range(NEWTON_STEPS):
            w = exp(q * x)
            e = pow(w, n) if gamma == 0.5 else exp(x)
            # The left side but for sign's constant, and its derivative along x.
            f, slope, power = e, e, 1.0
            for i in range(n - 1, -1, -1):
                if i < n - 1 or not self.is_sign:
                    curve = psi(self, i, e)
                    f += weight[i] * power * curve.value
                    slope += weight[i] * power * (q * (n - 1 - i) * curve.value + e * curve.slope)
                power *= w
            if f > target:
                high = x
            else:
                low = x
            change = log1p((f - target) / target) * f / slope
            moved = x - change
            if fabs(change) <= NEWTON_TOLERANCE:
                x = moved
                break
            # For sign the way from above is monotone. A fuzzy curve has corners: bisect then.
            x = moved if self.is_sign or low < moved < high else 0.5 * (low + high)
        e = max(exp(x), TINY)
        return Root(e, exp(q * x), psi(self, n - 1, e).value)

    cdef void grow(self, double a, double h) noexcept nogil:
        """Widen the fuzzy sets while all of them have been saturated for long (D 22)."""
        cdef Memory* memory = &self.memory
        if a > self.widest:
            memory.saturated += 1.0
            if memory.saturated >= SATURATED_SAMPLES:
                memory.scale *= 2.0
        else:
            memory.saturated = 0.0
            memory.scale = 1.0 + (memory.scale - 1.0) / (1.0 + h * self.relaxation)

    cdef double innovation_variance(self) noexcept nogil:
        return self.trial_covariance[0][0] + self.noise_variance

    cdef double most_change(self, int i) noexcept nogil:
        return OF_SIZE * self.next_size[i]

    cdef void go_on_after_jump(self, double of_state) noexcept nogil:
        """Let P say that z_1 is not known any more (D 23)."""
        cdef Memory* memory = &self.memory
        cdef Row* p = self.trial_covariance
        cdef int i, n = self.levels
        if memory.settled > 0.0:
            memcpy(p, self.steady, n * sizeof(Row))
            self.correct_covariance(1.0)
            memory.settled = -LONG_AGO
        else:
            memcpy(p, self.covariance, n * sizeof(Row))
        for i in range(n):
            p[0][i] = p[i][0] = 0.0
        p[0][0] = memory.miss * memory.miss
        memcpy(self.covariance, p, n * sizeof(Row))
