# SPDX-License-Identifier: Apache-2.0
"""What the two structures with fixed gains share: psi, the law of gamma, and the start (D 20)."""

from cython cimport final
from libc.math cimport INFINITY, NAN, exp, fabs, isfinite, pow
from libc.string cimport memcpy

from fhaosmo_ros.core.observer.kalman cimport correct, fill
from fhaosmo_ros.core.observer.status cimport GAMMA_AT_MAX, GAMMA_AT_MIN, SENSITIVITY_RESET
from fhaosmo_ros.core.observer.structure cimport GATE, Memory, Structure, has_drifted

# Sensitivities beyond it are set to 0.
cdef double SENSITIVITY_LIMIT = 1e9
# At the start the noise counts as so many times larger than `noise_size`; the logarithm of this
# factor decays within so many time constants of the steady Kalman filter.
cdef double NOISE_DOUBT = 3.0
cdef double DOUBTED = 2.0
LONG_AGO = 1e12
NEWTON_STEPS = 60
NEWTON_TOLERANCE = 3e-8
TINY = 1e-300
HUBER = 2.0
# Median of |x| where x is normal with variance 1, and by what part the spread follows a sample.
cdef double MEDIAN = 0.6745
cdef double SPREAD_RATE = 0.005


cdef double spread_after(double spread, double b, double expected) noexcept nogil:
    """
    Return the size of innovations over that expected, after one more (D 21).

    It goes up by a small part of it where |b| is above its median if it were normal, and down by
    as much where |b| is below. So the size of b does not matter, and outliers hardly do.
    """
    if fabs(b) > MEDIAN * spread * expected:
        return spread * (1.0 + SPREAD_RATE)
    return max(spread / (1.0 + SPREAD_RATE), 1.0)


cdef double follow_spread(Memory* memory, double b, double expected, double late) noexcept nogil:
    """
    Return the size that innovations have: the expected one times the spread, which follows (D 21).

    A sample that is too far off is counted in `Memory.beyond`; a late stamp puts it off by `late`.
    """
    cdef double usual
    memory.spread = spread_after(memory.spread, b, expected)
    usual = memory.spread * expected
    if fabs(b) > GATE * usual + late:
        memory.beyond += 1.0
        memory.miss = b
        if memory.beyond == 1.0:
            memory.first_miss = b
        return usual
    memory.beyond = 0.0
    if has_drifted(memory, b / usual):
        memory.beyond = INFINITY
    return usual


cdef double doubt_of_noise(double age, double speed) noexcept nogil:
    """Return the factor of the noise at some time after the start (D 20)."""
    return pow(NOISE_DOUBT, exp(-age * speed / DOUBTED))


cdef class SlidingMode(Structure):
    """An observer with fixed gains; `Cascade` and `Levant` are the two structures."""

    def __cinit__(self, configuration):
        cdef int i, n = self.levels
        p = configuration.parameters
        self.is_sign, self.adaptive = configuration.is_sign, configuration.adaptive
        self.sensitive = configuration.adaptive and p['gamma_rate'] > 0.0
        for i in range(n):
            self.gains[i].lambda_ = configuration.lambdas[i]
            self.gains[i].alpha = configuration.alphas[i]
            self.gains[i].inverse_width = 1.0 / configuration.widths[i]
            self.gains[i].decay = configuration.decays[i]
            self.first[i].z_hat = configuration.initial_estimate[i]
            self.first[i].z_tilde = configuration.initial_internal[i]
        self.table = configuration.curves
        self.curves, self.knots = &self.table[0, 0], configuration.curves.shape[1]
        self.gamma_initial, self.gamma_rate = configuration.gamma_initial, p['gamma_rate']
        self.gamma_min = p['gamma_min']
        self.dead_zone, self.leakage = p['gamma_dead_zone'], p['gamma_leakage']
        schedule = configuration.schedule
        self.scheduled = schedule is not None
        if self.scheduled:
            self.linear, self.noise_variance = schedule.linear, schedule.variance
            fill(self.fresh, schedule.fresh)

    cdef void reset(self) noexcept nogil:
        Structure.reset(self)
        SlidingMode.restart(self, NAN)
        self.level = self.first

    cdef void restart(self, double y) noexcept nogil:
        self.level, self.covariance = self.first, self.fresh
        self.level[0].z_hat = self.memory.y = y
        self.memory.gamma, self.memory.pending = self.gamma_initial, 0.0
        self.memory.settled = 0.0 if self.scheduled else 1.0

    def load_state_dict(self, values):
        """Load it, bring gamma within its bounds, and forget what is not carried along."""
        cdef int i
        Structure.load_state_dict(self, values)
        if self.adaptive:
            self.memory.gamma = min(max(self.memory.gamma, self.gamma_min), 1.0)
        else:
            self.memory.gamma = self.gamma_initial
        if not self.sensitive:
            for i in range(self.levels):
                self.level[i].p = self.level[i].q = 0.0
        if not (self.scheduled and self.predicting):  # nothing looks for a y that is off
            self.memory.y += self.memory.offset
            self.memory.beyond = self.memory.offset = self.memory.jumps = 0.0

    cdef void advance(self, double y, double h, const double* u) noexcept nogil:
        self.loss = self.gradient = 0.0
        if self.scheduled:
            memcpy(self.trial_covariance, self.covariance, self.levels * sizeof(Row))
        self.follow(y, h, u)

    cdef void follow(self, double y, double h, const double* u) noexcept nogil:
        """Advance the levels by the equations of the structure and its scheme."""

    cdef int accept(self, double y, double h) noexcept nogil:
        if self.scheduled:
            memcpy(self.covariance, self.trial_covariance, self.levels * sizeof(Row))
        return self.adapt(h) if self.adaptive else 0

    @final
    cdef int adapt(self, double h) noexcept nogil:
        """
        Change gamma (P adaptationlawgamma); return status flags.

        Projection on [gamma_min, 1], dead zone and leakage are ours (D 8).
        """
        cdef int word = 0, i
        cdef double gamma = self.memory.gamma
        cdef bint rests = self.loss <= self.dead_zone * self.dead_zone
        for i in range(self.levels):
            if not (fabs(self.level[i].p) < SENSITIVITY_LIMIT
                    and fabs(self.level[i].q) < SENSITIVITY_LIMIT):
                word = SENSITIVITY_RESET
        if word or not isfinite(self.gradient):
            word = SENSITIVITY_RESET
            for i in range(self.levels):
                self.level[i].p = self.level[i].q = 0.0
        if self.dead_zone == 0.0 or rests:
            gamma -= min(h * self.leakage, 1.0) * (gamma - self.gamma_initial)
        if not (word or rests):
            gamma -= h * self.gamma_rate * self.gradient  # P adaptationlawgamma
        if not gamma > self.gamma_min:  # also for NaN, from an infinite gradient step
            gamma = self.gamma_min
            word |= GAMMA_AT_MIN
        elif gamma >= 1.0:
            gamma = 1.0
            word |= GAMMA_AT_MAX
        self.memory.gamma = gamma
        return word

    cdef void predict_levels(self, double h, const double* u) noexcept nogil:
        """Let the prediction go on from the estimates by `h`."""
        cdef int i
        for i in range(self.levels):
            self.prediction.z[i], self.prediction.dz[i] = self.level[i].z_hat, 0.0
        self.prediction.over(h, u)

    cdef double bandwidth(self, double h) noexcept nogil:
        """Return the rate (1/s) at which the Kalman filter for samples every `h` forgets."""
        return pow(self.linear.intensity / (self.noise_variance * h), 0.5 / self.levels)

    cdef void correct_covariance(self, double doubt) noexcept nogil:
        """Take a sample into P; its noise counts as `doubt` times as large."""
        correct(self.levels, self.trial_covariance, doubt * doubt * self.noise_variance)
