# SPDX-License-Identifier: Apache-2.0
"""
What every observer remembers, and the step that all of them share.

`Structure` is the interface: the paper's cascade, Levant's differentiator and the self-tuning
observer implement it; runs, the policy of core/online and many channels call it.
"""

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS, Prediction
from fhaosmo_ros.core.observer.kalman cimport Row


cdef enum:
    MOST_INPUTS = 64  # known inputs


# More unlikely samples in a row say that y is lost, and innovations of so many standard deviations
# are too unlikely to be used (D 21).
cdef int LOST_SAMPLES
cdef double GATE


cdef struct Level:
    double z_hat  # filtered estimate of z_i (unit of z_i)
    double z_tilde  # internal state, of z_{i+1}; theta at the last level (unit of z_{i+1})
    double p  # d z_hat / d gamma (unit of z_i)
    double q  # d z_tilde / d gamma (unit of z_{i+1})


cdef struct Memory:
    # What any structure remembers.
    double y  # last accepted sample, less `offset`; NaN before the first (unit of y)
    double pending  # time of rejected samples, to be added to the next step (s)
    double period  # running mean of the intervals between samples (s)
    double offset  # what y is more than z_1, since a jump that the model contradicts (D 23)
    double jumps  # sum of the jumps of y, 0 once it is back (D 23, unit of y)
    double beyond  # samples in a row that are too far from their prediction to be likely (D 21)
    double first_miss  # prediction error of the first of them (unit of y)
    double miss  # and of the last one
    double spread  # size of the innovations over that expected, at least 1 (D 21)
    double watched  # samples for which it has yet to be watched whether only y jumped (D 23)
    double drift  # sum of the recent prediction errors over their usual size, while watched
    # What those with fixed gains remember.
    double gamma  # adaptive power
    double scale  # factor s of the half-widths and of the injections (D 22)
    double saturated  # samples in a row with |eps_1| beyond all half-widths (D 22)
    double settled  # 1: the gains are the tuned ones; else minus the time since the start (D 20)
    # What those remember that judge samples.
    double interval  # the last one between two samples, likely or not (s); 0: none yet
    double since  # time from the last sample that was used to the last one (s)
    double behind  # by how much the stamp of the last sample that was used was late (s)


cdef class Structure:
    # What the parameters say.
    cdef readonly object configuration  # ObserverConfiguration
    cdef readonly int order  # n
    cdef readonly int levels  # N
    cdef readonly int inputs  # known inputs m
    cdef readonly bint predicting  # it follows the model between samples, also through a gap
    cdef bint implicit  # a step uses the sample at its end
    cdef bint from_measurement  # z_1 begins at the first sample
    cdef bint internal  # estimates are the internal states
    cdef double epsilon  # threshold of the gates (unit of y)
    cdef Prediction prediction
    # What it remembers.
    cdef readonly Memory memory
    cdef Level level[MOST_LEVELS]
    cdef Row covariance[MOST_LEVELS]  # P of the errors (D 20); not used without noise_size
    # A step's own: the levels that a rejected sample goes back to, P while it is changed, and what
    # is found.
    cdef Level before[MOST_LEVELS]
    cdef Row trial_covariance[MOST_LEVELS]
    cdef double innovation[MOST_LEVELS]  # eps_i = m_i - z_hat_i after the latest sample
    cdef double loss, gradient  # L and dL/dgamma
    cdef double passed  # the time that a step takes for passed (s)
    cdef public int word  # status word of the latest sample
    cdef bint busy  # a run without the GIL is under way
    cdef bint placed  # the policy has placed the sample on a line: its time is no stamp

    # For whoever feeds it samples.
    cdef int start(self, double y) noexcept nogil
    cdef int step(self, double y, double h, const double* u) noexcept nogil
    cdef int measure(self, double y) noexcept nogil
    cdef void begin_at_estimates(self) noexcept nogil
    cdef double follow_interval(self, double h) noexcept nogil
    cdef double estimate(self, int i) noexcept nogil
    cdef void reset(self) noexcept nogil
    cdef void enter(self) except *
    # For a structure to implement.
    cdef void advance(self, double y, double h, const double* u) noexcept nogil
    cdef int accept(self, double y, double h) noexcept nogil
    cdef void restart(self, double y) noexcept nogil
    cdef double innovation_variance(self) noexcept nogil
    cdef double most_change(self, int i) noexcept nogil
    cdef void go_on_after_jump(self, double of_state) noexcept nogil
    cdef double variance(self, int i) noexcept nogil
    cdef void tell(self, double* model, double* tuning) noexcept nogil
    cdef bint is_noisy(self, double y) noexcept nogil
    cdef void begin_afresh(self) noexcept nogil
    cdef bint jump(self, const double* u) noexcept nogil


cdef bint has_drifted(Memory* memory, double off) noexcept nogil


cdef class Record:
    cdef Structure structure  # whose run it is
    # A row for each sample, as `Trajectory` says.
    cdef double[:, ::1] z_hat, z_tilde, innovation, standard_deviation, model, tuning
    cdef double[::1] gamma
    cdef int[::1] word
    cdef void write(self, Structure structure, Py_ssize_t row, int word) noexcept nogil


cdef class Estimate:
    cdef int order, levels
    cdef double values[MOST_LEVELS]  # z_1 .. z_n
    cdef double innovations[MOST_LEVELS]
    cdef readonly double unknown_input, gamma
    cdef readonly int word
