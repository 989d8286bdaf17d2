# SPDX-License-Identifier: Apache-2.0
"""
What every observer remembers, and the step that all of them share.

Equations are cited as P (paper: label of the equation) and D (number in docs/mathematics.md).
"""

from cython cimport final
from libc.math cimport INFINITY, NAN, fabs, isfinite, isnan, sqrt
from libc.string cimport memset

from fhaosmo_ros.core.model.phi cimport evaluate
from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS, Prediction
from fhaosmo_ros.core.observer.kalman cimport fill
from fhaosmo_ros.core.observer.status cimport (
    DIVERGED, FLAGS_MASK, JUMPED, LEVEL_SHIFT, REJECTED_INPUT, REJECTED_MEASUREMENT,
    REJECTED_PERIOD, REJECTED_SPIKE, REJECTED_STEP
)

from fhaosmo_ros.core.model.inputs import known_inputs
from fhaosmo_ros.core.observer.numbers import bounded, checked
from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

LOST_SAMPLES = 20
GATE = 6.0
# By this part the running mean of the intervals follows the latest one.
cdef double FOLLOWING = 1.0 / 32.0
# Values above the largest double over this are rejected, so that differences cannot overflow.
cdef double HEADROOM = 1e8
# Samples after a jump of y in which prediction errors may not sum up (D 23).
cdef double WATCH = 1000.0
# How many of these errors their sum remembers, and the sum that is too much: five standard
# deviations of that of white noise (D 23).
cdef double REMEMBERED = 100.0
cdef double MOST_DRIFT = 35.0
# If a jump of y would make |z_{i+1}| or |d| so much smaller, y was wrong before it (D 23).
cdef double MUCH_SMALLER = 0.5
OF_LEVELS = 'z_hat', 'z_tilde', 'p', 'q'


cdef bint has_drifted(Memory* memory, double off) noexcept nogil:
    """
    Return True if y has left its prediction since it jumped: the plant has jumped, too (D 23).

    `off` is the prediction error of a sample that is used, over its usual size.
    """
    if not memory.watched > 0.0:
        return False
    memory.watched = max(memory.watched - 1.0, 0.0)
    memory.drift += off - memory.drift / REMEMBERED
    return fabs(memory.drift) > MOST_DRIFT


cdef inline void copy_levels(int count, const Level* source, Level* target) noexcept nogil:
    """
    Copy levels number by number.

    A whole `Level` is read in wider pieces than those that were just written, for which a
    processor waits: a step of the paper's observer would take 10 % longer.
    """
    cdef int i
    for i in range(count):
        target[i].z_hat, target[i].z_tilde = source[i].z_hat, source[i].z_tilde
        target[i].p, target[i].q = source[i].p, source[i].q


cdef class Structure:
    """
    An observer of one output, whatever its structure, from an `ObserverConfiguration`.

    Two threads can not use one at the same time: the second one gets a RuntimeError.
    """

    def __cinit__(self, configuration):
        self.configuration = configuration
        self.order, self.levels = configuration.model.order, configuration.levels
        self.inputs = len(configuration.model.inputs)
        if self.inputs > MOST_INPUTS:
            raise ConfigurationError(
                f"parameter 'inputs': expected at most {MOST_INPUTS}, got {self.inputs}"
            )
        self.predicting, self.implicit = configuration.predicting, configuration.implicit
        self.from_measurement = configuration.parameters['start_from_measurement']
        self.internal = configuration.internal
        self.epsilon = configuration.epsilon
        self.prediction = Prediction(configuration.expressions, configuration.prediction_step)

    def __init__(self, configuration):
        self.reset()

    # What the policy, runs and channels call

    cdef int start(self, double y) noexcept nogil:
        """Take `y` as the first sample: no time has passed. Return a status word (status.py)."""
        cdef int word = 0
        self.memory.offset = 0.0
        if isfinite(HEADROOM * y):
            self.memory.y, self.memory.pending, self.memory.behind = y, 0.0, 0.0
            if self.from_measurement:
                self.level[0].z_hat = y
        else:
            word = REJECTED_MEASUREMENT
        return word | self.measure(self.memory.y)

    cdef int step(self, double y, double h, const double* u) noexcept nogil:
        """
        Advance to the sample `y` that lies `h` seconds after the last call; return a status word.

        A rejected sample changes no level; see `Status`.
        """
        cdef Memory* memory = &self.memory
        cdef int word = 0, i
        cdef double measured = y, elapsed, mean, zero = 0.0
        y -= memory.offset  # D 23
        if not isfinite(HEADROOM * y):
            word |= REJECTED_MEASUREMENT
        for i in range(self.inputs):
            if not isfinite(u[i]):
                word |= REJECTED_INPUT
        if not (h > 0.0 and isfinite(HEADROOM * h)):
            word |= REJECTED_PERIOD
        if not word:
            elapsed = h + memory.pending
            if elapsed + memory.behind <= 0.0:
                memory.behind = 0.0
            self.passed = elapsed + memory.behind
            copy_levels(self.levels, self.level, self.before)
            self.advance(y, self.passed, u)
            for i in range(self.levels):  # a difference of equals is 0, or NaN if not finite
                zero += HEADROOM * self.level[i].z_hat - HEADROOM * self.level[i].z_hat
                zero += HEADROOM * self.level[i].z_tilde - HEADROOM * self.level[i].z_tilde
            if zero != 0.0:
                word = REJECTED_STEP
                copy_levels(self.levels, self.before, self.level)
                # Nothing of the sample may make the next step fail as well: not its time, and not
                # the y at the interval's beginning, which is what fails explicitly.
                memory.pending = memory.behind = 0.0
                if not self.implicit:
                    memory.y = y
                self.begin_afresh()
            elif memory.beyond > LOST_SAMPLES and self.jump(u):
                memory.pending = elapsed
                word = REJECTED_SPIKE | JUMPED
            elif memory.beyond > LOST_SAMPLES:
                self.restart(measured)
                word = DIVERGED
            elif memory.beyond > 0.0:
                copy_levels(self.levels, self.before, self.level)
                memory.pending = elapsed
                word = REJECTED_SPIKE
            else:
                word = self.accept(y, self.passed)
                memory.behind = elapsed + memory.behind - self.passed
                memory.y, memory.pending = y, 0.0
                mean = memory.period if memory.period > 0.0 else self.passed
                memory.period = mean + FOLLOWING * (min(self.passed, 2.0 * mean) - mean)
        if word & (REJECTED_MEASUREMENT | REJECTED_INPUT) and not word & REJECTED_PERIOD:
            memory.pending += h
        return word | self.measure(memory.y)

    @final
    cdef int measure(self, double y) noexcept nogil:
        """Write eps_i = m_i - z_hat_i; return the number of open levels, shifted for a word."""
        cdef int i, count = 0
        cdef bint running = True
        cdef double m = y
        for i in range(self.levels):
            self.innovation[i] = m - self.level[i].z_hat
            count += running
            running = running and fabs(self.innovation[i]) <= self.epsilon  # P Eifunction
            m = self.level[i].z_tilde  # m_{i+1} = z_tilde_{i+1}
        return count << LEVEL_SHIFT

    cdef void begin_at_estimates(self) noexcept nogil:
        """Begin a prediction at the last sample and the internal estimates."""
        cdef int i
        for i in range(self.prediction.n):
            self.prediction.z[i] = self.level[i - 1].z_tilde if i > 0 else self.memory.y
            self.prediction.dz[i] = 0.0

    @final
    cdef double follow_interval(self, double h) noexcept nogil:
        """
        Return how much longer the interval before a sample is than the one before that.

        By as much may a host that was busy have stamped it late. `h` is the time since the last
        sample that was used, by their stamps; called once for each sample.
        """
        cdef Memory* memory = &self.memory
        cdef double interval = h - memory.since if memory.beyond > 0.0 else h
        cdef double change = interval - memory.interval if memory.interval > 0.0 else 0.0
        memory.interval, memory.since = interval, h
        return change

    @final
    cdef double estimate(self, int i) noexcept nogil:
        """Return the estimate of z_{i+1}, or of d for i = n, or of its derivatives behind it."""
        if i > 0 and (self.internal or i >= self.levels):
            return self.level[i - 1].z_tilde
        return self.level[i].z_hat

    cdef void reset(self) noexcept nogil:
        """Go back to the state before any sample."""
        memset(&self.memory, 0, sizeof(Memory))
        memset(self.level, 0, sizeof(self.level))
        memset(self.covariance, 0, sizeof(self.covariance))
        memset(self.innovation, 0, sizeof(self.innovation))
        self.memory.y = NAN
        self.memory.scale = self.memory.spread = 1.0

    cdef void enter(self) except *:
        """Raise RuntimeError while another thread runs this observer."""
        if self.busy:
            raise RuntimeError('this observer is in use by another thread: give each its own')

    # What a structure implements

    cdef void advance(self, double y, double h, const double* u) noexcept nogil:
        """
        Bring the levels, and write L and its gradient, to a sample `h` seconds after the last one.

        `Memory.beyond` counts samples that are too unlikely to be used.
        """

    cdef int accept(self, double y, double h) noexcept nogil:
        """Keep what a step has made; return status flags."""
        return 0

    cdef void restart(self, double y) noexcept nogil:
        """Begin afresh from `y`; the time of the next sample counts from it."""

    cdef double innovation_variance(self) noexcept nogil:
        """Return the variance that the latest innovation was expected to have."""
        return 0.0

    cdef double most_change(self, int i) noexcept nogil:
        """Return how much Phi_{i+1} may change in a jump of y that it does not contradict."""
        return 0.0

    cdef void go_on_after_jump(self, double of_state) noexcept nogil:
        """Go on after y has jumped; z_1 is another one by `of_state`."""

    cdef double variance(self, int i) noexcept nogil:
        """Return the variance of the error of z_{i+1}, or of d for i = n; NaN if not known."""
        return NAN

    cdef void tell(self, double* model, double* tuning) noexcept nogil:
        """Write the likeliest model of d, and what has been found; only self-tuning has them."""
        cdef int i
        for i in range(7):
            tuning[i] = NAN

    cdef bint is_noisy(self, double y) noexcept nogil:
        """Return True if y has noise, so that it does not repeat itself."""
        return False

    cdef void begin_afresh(self) noexcept nogil:
        """Forget what has been found of y: it may have made a step leave the finite numbers."""

    cdef bint jump(self, const double* u) noexcept nogil:
        """
        Go on with a y that alone has jumped (D 23).

        Return False if that is not what happened: y differs from its prediction by no constant, or
        the model says that the plant is now elsewhere. Then only `Memory.jumps` has changed.
        """
        cdef Memory* memory = &self.memory
        cdef double b = memory.miss, offset = memory.offset + b, total = memory.jumps + b
        cdef double small = GATE * memory.spread * sqrt(2.0 * self.innovation_variance())
        cdef double z[MOST_LEVELS]
        cdef double still[MOST_LEVELS]
        cdef double predicted = self.level[0].z_hat, change, behind
        cdef bint is_back = fabs(total) <= small, contradicted = False, larger = True
        cdef int i
        for i in range(self.levels):
            z[i], still[i] = self.level[i].z_hat, 0.0
        copy_levels(self.levels, self.before, self.level)
        if not (memory.beyond < INFINITY and fabs(b - memory.first_miss) <= small):
            memory.jumps = 0.0
            return False
        for i in range(self.levels):
            z[0] = predicted
            change = evaluate(self.prediction.phi, i, z, still, u).value
            z[0] = predicted + offset
            change -= evaluate(self.prediction.phi, i, z, still, u).value
            if not fabs(change) <= self.most_change(i):
                contradicted = True
                behind = z[i + 1] if i + 1 < self.levels else 0.0
                larger = larger and not fabs(behind + change) <= MUCH_SMALLER * fabs(behind)
        memory.jumps = 0.0 if is_back else total
        if contradicted and not is_back:
            if not larger:
                return False
            memory.offset = offset
        elif contradicted and memory.offset == 0.0:
            return False
        else:
            memory.offset = 0.0
            self.level[0].z_hat += offset
            memory.y += offset
        self.go_on_after_jump(self.level[0].z_hat - predicted)
        memory.beyond = memory.drift = 0.0
        memory.watched = WATCH
        return True

    # What Python calls

    def begin(self, double y):
        """Take the first sample; return the estimate."""
        self.enter()
        self.word = self.start(y)
        return self.report()

    def update(self, double y, double dt, u=0.0):
        """Advance by `dt` seconds to the sample `y`; return the estimate."""
        cdef double number
        cdef double inputs[MOST_INPUTS]
        cdef int i
        self.enter()
        if isnan(self.memory.y) and isfinite(y):
            self.start(y)
        if self.inputs == 1 and isinstance(u, float):
            number = u
            self.word = self.step(y, dt, &number)
            return self.report()
        for i, number in enumerate(known_inputs(u, self.configuration.model.inputs)):
            inputs[i] = number
        self.word = self.step(y, dt, inputs)
        return self.report()

    def report(self):
        """Return the estimate of the present state, with the status of the latest sample."""
        cdef Estimate estimate = Estimate.__new__(Estimate)
        cdef int i
        estimate.order, estimate.levels, estimate.word = self.order, self.levels, self.word
        estimate.innovations = self.innovation
        for i in range(self.order):
            estimate.values[i] = self.estimate(i)
        estimate.unknown_input, estimate.gamma = self.estimate(self.order), self.memory.gamma
        return estimate

    def forget(self):
        """Go back to the state before any sample."""
        self.enter()
        self.reset()

    @property
    def variances(self):
        """Variances of the errors of z and d, (n + 1,); NaN with fixed gains."""
        return np.array([self.variance(i) for i in range(self.order + 1)])

    @property
    def found(self):
        """What a self-tuning observer has found, (7,); NaN with fixed gains."""
        cdef double model[4]
        cdef double tuning[7]
        self.tell(model, tuning)
        return np.array(tuning)

    # Snapshots and copies

    def state_dict(self):
        """Return all that it remembers: name -> number, or array of one number a level."""
        cdef int n = self.levels
        cdef list levels = self.level
        cdef dict memory = self.memory
        self.enter()
        found = {name: np.array([level[name] for level in levels[:n]]) for name in OF_LEVELS}
        found['covariance'] = np.array(self.covariance)[:n, :n]
        return bounded(found | memory)

    def load_state_dict(self, values):
        """
        Go on where an observer of the same size was.

        Where a number is missing, of another size or out of its range it raises
        ConfigurationError, and nothing has changed.
        """
        cdef int i, n = self.levels
        cdef dict memory = self.memory
        self.enter()
        found = checked(values, Structure.state_dict(self))
        self.memory = {name: found[name] for name in memory}
        for i in range(n):
            self.level[i] = {name: found[name][i] for name in OF_LEVELS}
        fill(self.covariance, found['covariance'])
        self.measure(self.memory.y)

    def __reduce__(self):
        return type(self), (self.configuration,), self.state_dict() | {'word': self.word}

    def __setstate__(self, values):
        self.load_state_dict(values)
        self.word = values['word']


cdef class Record:
    """What a run of a structure records: a row for each sample."""

    def __cinit__(self, Structure structure not None, Py_ssize_t rows):
        cdef int levels = structure.levels
        own = (structure.order + 1, 4, 7) if structure.configuration.self_tuning else (0, 0, 0)
        self.structure = structure
        self.z_hat, self.z_tilde, self.innovation = (np.empty((rows, levels)) for _ in range(3))
        self.standard_deviation, self.model, self.tuning = (np.empty((rows, k)) for k in own)
        self.gamma, self.word = np.empty(rows), np.empty(rows, dtype=np.intc)

    cdef void write(self, Structure structure, Py_ssize_t row, int word) noexcept nogil:
        """Record what the observer knows."""
        cdef double* z_hat = &self.z_hat[row, 0]
        cdef double* z_tilde = &self.z_tilde[row, 0]
        cdef double* innovation = &self.innovation[row, 0]
        cdef int i
        for i in range(structure.levels):
            z_hat[i], z_tilde[i] = structure.level[i].z_hat, structure.level[i].z_tilde
            innovation[i] = structure.innovation[i]
        for i in range(<int>self.standard_deviation.shape[1]):
            self.standard_deviation[row, i] = sqrt(structure.variance(i))
        if self.model.shape[1] > 0:
            structure.tell(&self.model[row, 0], &self.tuning[row, 0])
        self.gamma[row], self.word[row] = structure.memory.gamma, word

    @property
    def columns(self):
        """The same by the names of `Trajectory`, with the estimates that `estimate` returns."""
        cdef int n = self.structure.order
        cdef int filtered = 1 if self.structure.internal else min(self.structure.levels, n + 1)
        z_hat, z_tilde = np.asarray(self.z_hat), np.asarray(self.z_tilde)
        word = np.asarray(self.word)
        estimates = np.hstack([z_hat[:, :filtered], z_tilde[:, filtered - 1:n]])
        return {
            'z': estimates[:, :n], 'unknown_input': estimates[:, n],
            'gamma': np.asarray(self.gamma), 'innovation': np.asarray(self.innovation),
            'status': (word & FLAGS_MASK).astype(np.int64),
            'open_levels': (word >> LEVEL_SHIFT).astype(np.int64),
            'z_hat': z_hat, 'z_tilde': z_tilde,
            'standard_deviation': np.asarray(self.standard_deviation),
            'model': np.asarray(self.model), 'tuning': np.asarray(self.tuning),
        }


def run(
    Structure structure not None, const double[::1] y, const double[::1] h,
    const double[:, ::1] u
):
    """
    Start with samples until one is good, step from the next one on; record the state after each.

    `h` are the times (s) of the intervals that end at each sample, `u` the inputs of these.
    """
    cdef Record record = Record(structure, y.shape[0])
    cdef Py_ssize_t k
    if not (h.shape[0] == u.shape[0] == y.shape[0] and u.shape[1] == structure.inputs):
        raise ValueError('run: arrays of different lengths')
    structure.enter()
    structure.busy = True
    with nogil:
        for k in range(y.shape[0]):
            if isnan(structure.memory.y):
                structure.word = structure.start(y[k])
            else:
                structure.word = structure.step(y[k], h[k], &u[k, 0])
            record.write(structure, k, structure.word)
    structure.busy = False
    return record


cdef class Estimate:
    """
    What an observer knows after a sample.

    Attributes
    ----------
    z : (n,) array
        Estimated states; z[0] is z_hat_1, the others follow `estimate_from`.
    unknown_input : float
        Estimated d.
    gamma : float
        Power gamma in use.
    innovation : (N,) array
        eps_i = m_i - z_hat_i.
    word : int
        Status word; see `status` and `open_levels`.

    """

    def __init__(self, z, double unknown_input, double gamma, innovation, int word):
        cdef int i
        self.order, self.levels = len(z), len(innovation)
        if max(self.order, self.levels) > MOST_LEVELS:
            raise ValueError(f'estimate: expected at most {MOST_LEVELS} levels')
        for i in range(self.order):
            self.values[i] = z[i]
        for i in range(self.levels):
            self.innovations[i] = innovation[i]
        self.unknown_input, self.gamma, self.word = unknown_input, gamma, word

    @property
    def z(self):
        """Estimated states."""
        return np.array([self.values[i] for i in range(self.order)])

    @property
    def innovation(self):
        """Innovations of the levels."""
        return np.array([self.innovations[i] for i in range(self.levels)])

    @property
    def status(self):
        """Flags of the step."""
        return Status(self.word & FLAGS_MASK)

    @property
    def open_levels(self):
        """Number of levels that run (the paper's E_i)."""
        return self.word >> LEVEL_SHIFT

    def __reduce__(self):
        return Estimate, (self.z, self.unknown_input, self.gamma, self.innovation, self.word)

    def __repr__(self):
        return (
            f'Estimate(z={self.z}, unknown_input={self.unknown_input:.6g}, '
            f'gamma={self.gamma:.6g}, status={self.status!r})'
        )
