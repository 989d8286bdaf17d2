# SPDX-License-Identifier: Apache-2.0
"""
The paper's observer, a cascade of super-twisting levels: every variant, both schemes.

Equations are cited as P (paper: label of the equation) and D (number in docs/mathematics.md).
The super-twisting algorithm: Levant 1998 (doi:10.1016/S0005-1098(97)00209-4), Moreno and Osorio
2012 (doi:10.1109/TAC.2012.2186179); its implicit discretisation: Acary and Brogliato 2010
(doi:10.1016/j.sysconle.2010.03.002).
"""

from cython cimport final
from libc.math cimport copysign, exp, fabs, log, log1p, pow, sqrt

from fhaosmo_ros.core.model.phi cimport Dual, evaluate
from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.sliding_mode cimport (
    NEWTON_STEPS, NEWTON_TOLERANCE, TINY, SlidingMode, doubt_of_noise, psi
)
from fhaosmo_ros.core.observer.structure cimport Level, Memory

# Time constants of the steady Kalman filter after which its errors are steady.
cdef double LONG = 8.0
# Innovations of more standard deviations count as so many at the start.
cdef double MOST_SIGMAS = 3.0
cdef int BISECTIONS = 60


cdef struct Root:
    double eps  # |eps| >= 0
    double s  # psi(eps), or what the set-valued sign takes


cdef class Cascade(SlidingMode):
    """The paper's observer: level i follows z_i by the super-twisting algorithm."""

    cdef void follow(self, double y, double h, const double* u) noexcept nogil:
        """Advance the levels by the scheme, or start as a Kalman filter."""
        if self.scheduled and self.memory.settled <= 0.0:
            self.start_as_kalman(y, h, u)
        elif self.implicit:
            self.backward(self.memory.gamma, y, h, u)
        else:
            self.explicit(self.memory.gamma, self.memory.y, h, u)

    cdef void start_as_kalman(self, double y, double h, const double* u) noexcept nogil:
        """Estimate by the Kalman filter itself until P is steady (D 20); sensitivities rest."""
        cdef Memory* memory = &self.memory
        cdef int i, n = self.levels
        cdef double speed = self.bandwidth(h), doubt = doubt_of_noise(-memory.settled, speed)
        cdef double s, b
        self.linear.predict(self.trial_covariance, h)
        s = self.trial_covariance[0][0] + doubt * doubt * self.noise_variance
        self.predict_levels(h, u)
        b = y - self.prediction.z[0]
        b = min(max(b, -MOST_SIGMAS * sqrt(s)), MOST_SIGMAS * sqrt(s))
        for i in range(n):
            # K = P C' / S
            self.level[i].z_hat = self.prediction.z[i] + self.trial_covariance[0][i] / s * b
            self.level[i].p = self.level[i].q = 0.0
        for i in range(n):
            self.level[i].z_tilde = self.level[i + 1].z_hat if i + 1 < n else 0.0
        self.correct_covariance(doubt)
        memory.settled -= h
        if -memory.settled * speed > LONG:
            self.hand_over(u)
            memory.settled = 1.0

    cdef void hand_over(self, const double* u) noexcept nogil:
        """
        Put the levels where they would be if they had followed the estimates of the filter.

        Level i then has alpha_i psi_i(eps_i) = z_{i+1}', and its internal state lags by its
        injection.
        """
        cdef double z[MOST_LEVELS + 2]
        cdef double still[MOST_LEVELS]
        cdef double m = self.level[0].z_hat, rate, wanted, low, high, middle, injection
        cdef int i, _, n = self.levels
        for i in range(n):
            z[i], still[i] = self.level[i].z_hat, 0.0
        z[n] = z[n + 1] = 0.0
        for i in range(n):
            rate = z[i + 2]
            if i + 1 < n:
                rate += evaluate(self.prediction.phi, i + 1, z, still, u).value
            wanted = min(fabs(rate) / self.gains[i].alpha, 1.0)
            low, high = 0.0, 0.0 if self.is_sign else 1.0 / self.gains[i].inverse_width
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                if psi(self, i, middle).value < wanted:
                    low = middle
                else:
                    high = middle
            injection = self.gains[i].lambda_ * pow(high, self.memory.gamma) * wanted
            injection = injection if high > 0.0 else 0.0
            self.level[i].z_hat = m - copysign(high, rate)
            m = self.level[i].z_tilde = z[i + 1] - copysign(injection, rate)

    @final
    cdef void explicit(self, double gamma, double y, double h, const double* u) noexcept nogil:
        """
        Forward Euler of P adaptivesupertwistingobserverfuzzymodified.

        With psi = sign and gamma = 1/2 it is P triangularObserver, with gamma = 1/2 P fuzzysuper.
        `y` is the sample at the interval's beginning, and so are L and its gradient.
        """
        cdef Level* level
        cdef double m[MOST_LEVELS]
        cdef double dm[MOST_LEVELS]
        cdef double eps, s, a, lambda_, alpha, decay, log_a, power, injection, dinjection
        cdef double loss = 0.0, gradient = 0.0
        cdef Dual phi, curve
        cdef bint running = True
        cdef int i
        m[0], dm[0] = y, 0.0
        for i in range(1, self.levels):
            m[i], dm[i] = self.level[i - 1].z_tilde, self.level[i - 1].q  # m_i = z_tilde_i
        for i in range(self.levels):
            level = &self.level[i]
            eps = m[i] - level.z_hat
            s = dm[i] - level.p  # s_i = d eps_i / d gamma
            loss += eps * eps  # P lossfunction
            gradient += 2.0 * eps * s
            if not running:
                continue  # P Eifunction: E_{i-1} = 0 holds the level
            phi = evaluate(self.prediction.phi, i, m, dm, u)
            lambda_, alpha = self.gains[i].lambda_, self.gains[i].alpha
            decay = self.gains[i].decay
            a = fabs(eps)
            curve = psi(self, i, a)
            injection = dinjection = 0.0
            if a > 0.0:
                if self.adaptive:
                    log_a = log(a)
                    power = exp(gamma * log_a)
                    injection = lambda_ * power * copysign(curve.value, eps)
                    # D 6: explicit dependence on gamma, and the chain through eps
                    dinjection = injection * log_a + lambda_ * power * s * (
                        gamma * curve.value / a + curve.slope
                    )
                else:
                    injection = lambda_ * sqrt(a) * copysign(curve.value, eps)
            else:
                curve.value = 0.0
            if self.sensitive:
                level.p += h * (level.q + dinjection + phi.slope)
                level.q += h * (alpha * curve.slope * s - decay * level.q)
            level.z_hat += h * (level.z_tilde + injection + phi.value)  # P: z_hat_i'
            # P: z_tilde_{i+1}', and D 15
            level.z_tilde += h * (alpha * copysign(curve.value, eps) - decay * level.z_tilde)
            running = a <= self.epsilon  # P Eifunction
        self.loss, self.gradient = loss, gradient

    cdef void backward(self, double gamma, double y, double h, const double* u) noexcept nogil:
        """
        Backward Euler of the same equations, one scalar equation a level (D 9).

        `y` is the sample at the interval's end, and so are L and its gradient.
        """
        cdef Level* level
        cdef double m[MOST_LEVELS]
        cdef double dm[MOST_LEVELS]
        cdef double held, keep, b, db, damping, stiffness, power, log_a, deps, dpsi
        cdef double loss = 0.0, gradient = 0.0
        cdef Dual phi, curve
        cdef Root root
        cdef bint running = True
        cdef int i
        m[0], dm[0] = y, 0.0
        for i in range(self.levels):
            level = &self.level[i]
            if i > 0:  # already at the new time
                m[i], dm[i] = self.level[i - 1].z_tilde, self.level[i - 1].q
            if not running:
                held = m[i] - level.z_hat
                loss += held * held
                gradient += 2.0 * held * (dm[i] - level.p)
                continue
            phi = evaluate(self.prediction.phi, i, m, dm, u)
            keep = decayed(self.gains[i].decay, h)
            level.z_tilde *= keep
            b = m[i] - level.z_hat - h * (level.z_tilde + phi.value)
            root = self.root(i, fabs(b), h, gamma)
            loss += root.eps * root.eps  # P lossfunction
            if self.sensitive:  # D 10: implicit function theorem on the equation of `root`
                level.q *= keep
                db = dm[i] - level.p - h * (level.q + phi.slope)
                damping = h * self.gains[i].lambda_
                stiffness = h * h * self.gains[i].alpha * keep
                curve = psi(self, i, root.eps)
                if root.eps > 0.0:
                    log_a = log(root.eps)
                    power = exp(gamma * log_a)
                    deps = (db - copysign(damping * power * root.s, b) * log_a) / (
                        1.0 + damping * power * (gamma * root.s / root.eps + curve.slope)
                        + stiffness * curve.slope
                    )
                    dpsi = curve.slope * deps
                elif self.is_sign:  # sliding: s = b / (h^2 alpha)
                    deps, dpsi = 0.0, db / stiffness
                else:
                    deps = db / (1.0 + stiffness * curve.slope)
                    dpsi = curve.slope * deps
                level.q += h * keep * self.gains[i].alpha * dpsi
                level.p = dm[i] - deps
                gradient += 2.0 * copysign(root.eps, b) * deps
            level.z_tilde += h * keep * self.gains[i].alpha * copysign(root.s, b)
            level.z_hat = m[i] - copysign(root.eps, b)
            running = root.eps <= self.epsilon  # P Eifunction
        self.loss, self.gradient = loss, gradient

    cdef Root root(self, int i, double b, double h, double gamma) noexcept nogil:
        """
        Solve eps + h lambda |eps|^gamma s + h^2 alpha s = b, s in psi(eps), b >= 0 (D 9, D 16).

        The left side increases with eps, so there is one root in [0, b].
        """
        cdef double damping = h * self.gains[i].lambda_
        cdef double stiffness = h * h * self.gains[i].alpha * decayed(self.gains[i].decay, h)
        cdef double rest, r, x, e, power, f, change, low, high, slope, moved
        cdef Dual curve
        cdef int _
        if b < TINY:
            return Root(0.0, 0.0)
        if self.is_sign and b <= stiffness:
            return Root(0.0, b / stiffness)  # sliding: the set-valued sign takes what is needed
        if self.is_sign and gamma == 0.5:
            rest = b - stiffness
            # The positive root of r^2 + damping r - rest, in the form that does not cancel.
            r = 2.0 * rest / (damping + sqrt(damping * damping + 4.0 * rest))
            return Root(r * r, 1.0)
        if self.is_sign:
            # Both bounds are above the root. From there Newton's method on the logarithm of the
            # left side over that of e is monotone (it is convex), and quick for any gamma.
            rest = b - stiffness
            x = min(log(rest), log(rest / damping) / gamma)
            for _ in range(NEWTON_STEPS):
                e, power = exp(x), damping * exp(gamma * x)
                f = e + power
                change = log1p((f - rest) / rest) * f / (e + gamma * power)
                x -= change
                if fabs(change) <= NEWTON_TOLERANCE:
                    break
            return Root(max(exp(x), TINY), 1.0)
        low, high = 0.0, b
        e = fabs(self.innovation[i])  # that of the last step is near
        if not 0.0 < e < b:
            e = b / (1.0 + stiffness * psi(self, i, 0.0).slope)
        for _ in range(NEWTON_STEPS):
            curve = psi(self, i, e)
            power = sqrt(e) if gamma == 0.5 else exp(gamma * log(e))
            f = e + (damping * power + stiffness) * curve.value - b
            if f > 0.0:
                high = e
            else:
                low = e
            slope = 1.0 + damping * (gamma * power / e * curve.value + power * curve.slope)
            change = f / (slope + stiffness * curve.slope)
            moved = e - change
            if fabs(change) <= NEWTON_TOLERANCE * e:
                e = moved
                break
            e = moved if low < moved < high else 0.5 * (low + high)
        return Root(e, psi(self, i, e).value)


cdef inline double decayed(double decay, double h) noexcept nogil:
    """Return the factor by which a backward Euler step shrinks an internal state (D 16)."""
    return 1.0 / (1.0 + h * decay) if decay > 0.0 else 1.0
