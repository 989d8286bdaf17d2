# SPDX-License-Identifier: Apache-2.0
"""
What the two structures with fixed gains share: psi, the law of gamma, scheduled gains.

With `noise_size` the covariance P of the errors follows the Kalman filter of the model, linearised
at rest, with a Matern model of d (D 17, D 20). It begins with the sizes of the states, of d and of
the noise that parameters tell, and makes gains larger until it is steady. It also says which
samples are unlikely (D 21).
"""

from libc.math cimport INFINITY, exp, fabs, isfinite, pow, sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy

from fhaosmo_ros.core.model.phi cimport Dual
from fhaosmo_ros.core.observer.kalman cimport correct
from fhaosmo_ros.core.observer.status cimport GAMMA_AT_MAX, GAMMA_AT_MIN, SENSITIVITY_RESET
from fhaosmo_ros.core.observer.structure cimport GATE, Memory, Structure, has_drifted

# Sensitivities beyond it are set to 0.
cdef double SENSITIVITY_LIMIT = 1e9
# Innovations of so many times their usual size let gamma adapt (D 8).
cdef double UNUSUAL = 3.0
# Time constants of the steady Kalman filter after which its errors are steady.
cdef double LONG = 8.0
# Median of |x| where x is normal with variance 1, and by what part the spread follows a sample.
cdef double MEDIAN = 0.6745
cdef double SPREAD_RATE = 0.005
# A jump of y contradicts the model if it changes a Phi by more than this part of its size.
cdef double OF_SIZE = 0.25
# At the start the noise counts as so many times larger than `noise_size`; the logarithm of this
# factor decays within so many time constants of the steady Kalman filter.
cdef double NOISE_DOUBT = 3.0
cdef double DOUBTED = 2.0
LONG_AGO = 1e12
NEWTON_STEPS = 60
NEWTON_TOLERANCE = 3e-8
TINY = 1e-300
HUBER = 2.0


cdef double doubt_of_noise(double age, double speed) noexcept nogil:
    """Return the factor of the noise at some time after the start (D 20)."""
    return pow(NOISE_DOUBT, exp(-age * speed / DOUBTED))


cdef double follow_spread(Memory* memory, double b, double expected) noexcept nogil:
    """
    Return the size that innovations have: the expected one times the spread, which follows (D 21).

    The spread goes up by a small part of it where |b| is above its median if it were normal, and
    down by as much where |b| is below. So its size does not matter, and outliers hardly do. A
    sample that is too far off is counted in `Memory.beyond`.
    """
    cdef double usual
    if fabs(b) > MEDIAN * memory.spread * expected:
        memory.spread *= 1.0 + SPREAD_RATE
    else:
        memory.spread = max(memory.spread / (1.0 + SPREAD_RATE), 1.0)
    usual = memory.spread * expected
    if fabs(b) > GATE * usual:
        memory.beyond += 1.0
        memory.miss = b
        if memory.beyond == 1.0:
            memory.first_miss = b
        return usual
    memory.beyond = 0.0
    if has_drifted(memory, b / usual):
        memory.beyond = INFINITY
    return usual


cdef class SlidingMode(Structure):
    """An observer with fixed gains; `Cascade` and `Levant` are the two structures."""

    def __cinit__(self, configuration):
        cdef int i, j, n = self.levels
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
        self.knots = configuration.curves.shape[1]
        self.curves = <double*>malloc(n * self.knots * sizeof(double))
        if self.curves == NULL:
            raise MemoryError
        for i in range(n):
            for j in range(self.knots):
                self.curves[i * self.knots + j] = configuration.curves[i, j]
        self.gamma_initial, self.gamma_rate = configuration.gamma_initial, p['gamma_rate']
        self.gamma_min, self.gamma_max = p['gamma_min'], p['gamma_max']
        self.dead_zone, self.leakage = p['gamma_dead_zone'], p['gamma_leakage']
        self.leakage_delay = p['gamma_leakage_delay']
        self.correction_period = p['correction_period']
        schedule = configuration.schedule
        self.scheduled = schedule is not None
        if self.scheduled:
            self.linear, self.noise_variance = schedule.linear, schedule.variance
            self.steady_variance = schedule.steady[0, 0] + schedule.variance
            for i in range(n):
                self.tuned_over_kalman[i] = schedule.tuned_over_kalman[i]
                self.next_size[i] = schedule.next_sizes[i]
                for j in range(n):
                    self.fresh[i][j] = schedule.fresh[i, j]
                    self.steady[i][j] = schedule.steady[i, j]

    def __dealloc__(self):
        free(self.curves)

    cdef void reset(self) noexcept nogil:
        """Go back to the state before any sample."""
        Structure.reset(self)
        self.level = self.first
        self.covariance = self.fresh
        self.memory.gamma = self.gamma_initial
        self.memory.settled = 0.0 if self.scheduled else 1.0

    cdef void restart(self, double y) noexcept nogil:
        """Begin afresh from `y`; the time of the next sample counts from it."""
        cdef Memory* memory = &self.memory
        self.level = self.first
        self.covariance = self.fresh
        self.level[0].z_hat = memory.y = y
        if self.adaptive:
            memory.gamma = self.gamma_initial
        memory.pending = memory.wait = memory.saturated = memory.beyond = memory.settled = 0.0
        memory.upset = memory.offset = memory.watched = memory.drift = memory.one_sided = 0.0
        memory.scale = 1.0

    def take_over(self, Structure before):
        """Go on with the state of an observer that has other live parameters."""
        cdef SlidingMode other = before
        cdef int i, j
        cdef bint same = self.scheduled == other.scheduled
        before.enter()
        self.level, self.covariance, self.memory = before.level, before.covariance, before.memory
        self.innovation = before.innovation
        for i in range(self.levels):
            for j in range(self.levels):
                same = same and self.steady[i][j] == other.steady[i][j]
        if not same:  # P is of other sizes
            self.memory.settled = 1.0
        if not other.sensitive or type(self) is not type(before):
            self.forget_sensitivities()  # they were not carried along
        self.fit()

    def load_state_dict(self, values):
        """Go on where an observer of the same size was; see `Structure.load_state_dict`."""
        Structure.load_state_dict(self, values)
        self.fit()

    cdef void fit(self) noexcept:
        """Bring gamma within its bounds, and forget what is not carried along."""
        if self.adaptive:
            self.memory.gamma = min(max(self.memory.gamma, self.gamma_min), self.gamma_max)
        else:
            self.memory.gamma = self.gamma_initial
        if not self.sensitive:
            self.forget_sensitivities()
        if not self.scheduled and self.memory.offset != 0.0:
            self.memory.y += self.memory.offset
            self.memory.offset = self.memory.jumps = 0.0

    cdef void forget_sensitivities(self) noexcept:
        """Set the sensitivities to 0."""
        cdef int i
        for i in range(self.levels):
            self.level[i].p = self.level[i].q = 0.0

    def curve(self, int level, double a):
        """Return psi of a level (0-based) at a >= 0, and its slope."""
        if not 0 <= level < self.levels or not a >= 0.0:
            raise ValueError(f'curve: expected a level below {self.levels} and a >= 0')
        cdef Dual found = psi(self, level, a)
        return found.value, found.slope

    cdef void advance(self, double y, double h, const double* u) noexcept nogil:
        """See `Structure.advance`."""
        self.loss = self.gradient = 0.0
        if self.scheduled and not self.predicting:
            memcpy(self.trial_covariance, self.covariance, self.levels * sizeof(Row))
            if self.memory.settled <= 0.0:
                self.begin_estimates(y, h, u)
                return
            follow_spread(
                &self.memory, y - self.predicted_y(h, u),
                sqrt(self.trial_covariance[0][0] + self.noise_variance),
            )
            if self.memory.beyond > 0.0:
                return
        self.follow(y, h, u)

    cdef void follow(self, double y, double h, const double* u) noexcept nogil:
        """Advance `trial` by the equations of the structure and its scheme."""

    cdef double predicted_y(self, double h, const double* u) noexcept nogil:
        """Return y after one Euler step of the internal states (D 21)."""
        return self.memory.y

    cdef void hand_over(self, const double* u) noexcept nogil:
        """Put the levels where they would be if they had followed the estimates of `trial`."""

    cdef int accept(self, double y, double h) noexcept nogil:
        """Make `trial` the state, adapt gamma; return status flags."""
        cdef int word = 0
        cdef double eps
        cdef Memory* memory = &self.memory
        if self.adaptive:
            memory.upset = max(memory.upset - h, 0.0)
            eps = y - self.trial[0].z_hat if self.implicit else memory.y - self.level[0].z_hat
            if not self.is_sign and fabs(eps) * self.gains[0].inverse_width > 1.0:
                memory.upset = self.leakage_delay  # y's own innovation is beyond its half-width
            word = self.adapt(h)
        Structure.accept(self, y, h)
        if self.scheduled:
            memcpy(self.covariance, self.trial_covariance, self.levels * sizeof(Row))
        return word

    cdef int adapt(self, double h) noexcept nogil:
        """
        Change gamma (P adaptationlawgamma); return status flags.

        Projection on [gamma_min, gamma_max], dead zone, leakage, and the rest after an upset are
        ours (D 8).
        """
        cdef Memory* memory = &self.memory
        cdef int word = 0, i
        cdef double gamma = memory.gamma, dead_zone = self.dead_zone, change
        cdef bint leaks = self.dead_zone == 0.0
        for i in range(self.levels):
            if not (fabs(self.trial[i].p) < SENSITIVITY_LIMIT
                    and fabs(self.trial[i].q) < SENSITIVITY_LIMIT):
                word = SENSITIVITY_RESET
        if word or not isfinite(self.gradient):
            word = SENSITIVITY_RESET
            for i in range(self.levels):
                self.trial[i].p = self.trial[i].q = 0.0
        if self.scheduled and not leaks:  # the dead zone follows the noise
            if not memory.upset > 0.0:
                change = 1.0 + h / max(self.leakage_delay, h)
                if self.loss > memory.usual * memory.usual:
                    memory.usual *= change
                else:
                    memory.usual *= 1.0 / change
            memory.usual = max(memory.usual, dead_zone / UNUSUAL)
            dead_zone = UNUSUAL * memory.usual
        if self.loss <= dead_zone * dead_zone:  # adaptation rests
            leaks = leaks or memory.wait <= 0.0
            memory.wait = max(memory.wait - h, 0.0)
        else:
            memory.wait = self.leakage_delay
            if not word and not (memory.upset > 0.0 and self.dead_zone > 0.0):
                gamma -= h * self.gamma_rate * self.gradient  # P adaptationlawgamma
        if leaks:
            gamma -= min(h * self.leakage, 1.0) * (gamma - self.gamma_initial)
        if not gamma > self.gamma_min:  # also for NaN, from an infinite gradient step
            gamma = self.gamma_min
            word |= GAMMA_AT_MIN
        elif gamma >= self.gamma_max:
            gamma = self.gamma_max
            word |= GAMMA_AT_MAX
        memory.gamma = gamma
        return word

    cdef void predict_trial(self, double h, const double* u) noexcept nogil:
        """Let the prediction go on from the estimates of `trial` by `h`."""
        cdef int i
        for i in range(self.levels):
            self.prediction.z[i], self.prediction.dz[i] = self.trial[i].z_hat, 0.0
        self.prediction.over(h, u)

    # Scheduled gains

    cdef double bandwidth(self, double h) noexcept nogil:
        """Return the rate (1/s) at which the Kalman filter for samples every `h` forgets."""
        return pow(self.linear.intensity / (self.noise_variance * h), 0.5 / self.levels)

    cdef void correct_trial(self, double doubt) noexcept nogil:
        """Take a sample into P; its noise counts as `doubt` times as large."""
        correct(self.levels, self.trial_covariance, doubt * doubt * self.noise_variance)

    cdef void begin_estimates(self, double y, double h, const double* u) noexcept nogil:
        """
        Estimate by the Kalman filter itself until P is steady, for schemes with other gains.

        Sensitivities rest.
        """
        cdef Memory* memory = &self.memory
        cdef int i, n = self.levels
        cdef double speed = self.bandwidth(h), doubt = doubt_of_noise(-memory.settled, speed)
        cdef double noise = doubt * doubt * self.noise_variance, s, b
        self.linear.predict(self.trial_covariance, h)
        s = self.trial_covariance[0][0] + noise
        self.predict_trial(h, u)
        b = y - self.prediction.z[0]
        follow_spread(memory, b, sqrt(s))
        if memory.beyond > 0.0:
            return
        for i in range(n):
            self.trial[i].z_hat = (
                self.prediction.z[i] + self.trial_covariance[0][i] / s * b  # K = P C' / S
            )
            self.trial[i].p = self.trial[i].q = 0.0
        for i in range(n):
            self.trial[i].z_tilde = self.trial[i + 1].z_hat if i + 1 < n else 0.0
        self.correct_trial(doubt)
        self.loss = (1.0 - self.trial_covariance[0][0] / noise) * b * b
        memory.settled -= h
        if -memory.settled * speed > LONG:
            self.hand_over(u)
            memory.settled = 1.0

    cdef double innovation_variance(self) noexcept nogil:
        """Return the variance that the latest innovation was expected to have."""
        return self.trial_covariance[0][0] + self.noise_variance

    cdef double most_change(self, int i) noexcept nogil:
        """Return how much Phi_{i+1} may change in a jump of y that it does not contradict."""
        return OF_SIZE * self.next_size[i]

    cdef void go_on_after_jump(self, double of_state) noexcept nogil:
        """Let P say that z_1 is not known any more (D 23)."""
        cdef Memory* memory = &self.memory
        cdef Row* p = self.trial_covariance
        cdef int i, n = self.levels
        if not (self.predicting or memory.settled <= 0.0):
            return
        if memory.settled > 0.0:
            memcpy(p, self.steady, n * sizeof(Row))
            self.correct_trial(1.0)
        else:
            memcpy(p, self.covariance, n * sizeof(Row))
        for i in range(n):
            p[0][i] = p[i][0] = 0.0
        p[0][0] = memory.miss * memory.miss
        memcpy(self.covariance, p, n * sizeof(Row))
        if memory.settled > 0.0:
            memory.settled = -LONG_AGO
