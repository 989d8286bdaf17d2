# SPDX-License-Identifier: Apache-2.0
"""A recording, row by row, and what is known of each time by all of it (D 24, D 25, D 34)."""

from fhaosmo_ros.core.model.prediction cimport Prediction
from fhaosmo_ros.core.observer.kalman cimport Row
from fhaosmo_ros.core.observer.structure cimport Memory


cpdef enum:
    MEASURED  # a sample that was used
    UNMEASURED  # a time at which none was used
    JUMPS  # the first sample that was used after a jump of y alone (D 23)
    BEGINS  # the first one of a fresh start


cdef struct Point:
    # What a row has one number of.
    double y  # sample, less its offset (D 23)
    double h  # time since the row before (s)
    double variance  # of the noise on y
    double intensity  # of the white noise that drives the last level of d
    double decay  # kappa of D 26 (1/s), with d and its derivatives as there; 0: as in phi
    double derivatives  # k of the model of d; k - 4: d has jumped since the row before (D 33)
    double pull  # e / S; this and the next two are 0 without a sample
    double certainty  # 1 / S
    double noise  # variance that the sample is taken to have
    long long time  # ns
    int kind  # MEASURED .. BEGINS
    int last  # the level that white noise drives


cdef class Rows:
    # What the parameters say.
    cdef readonly object configuration
    cdef Prediction prediction
    cdef int n, order, inputs  # levels; states and known inputs of the model
    cdef bint tunes  # a self-tuning observer: the model of d is another one in each row
    cdef bint from_measurement  # z_1 begins at the first sample
    cdef double fastest  # rate of the fastest motion of the model (1/s)
    cdef object model  # variance, intensity, decay and derivatives of d; of fixed gains
    cdef double[::1] first  # estimates of a fresh observer
    cdef double[::1] state_sizes
    cdef double[:, ::1] fresh  # P of a fresh observer
    # What it remembers beside the rows.
    cdef Memory memory  # the size of the innovations (D 21), nothing else
    cdef bint busy  # a thread appends rows
    cdef readonly Py_ssize_t count  # rows
    cdef readonly Py_ssize_t done  # those of them that have been handed out
    cdef readonly Py_ssize_t began  # the latest one that begins; below 0 if it has been dropped
    cdef Py_ssize_t new  # the first of those that came last
    # The rows, with room for some more.
    cdef dict columns  # the arrays by name
    cdef Point[::1] point
    cdef double[:, ::1] u  # known inputs since the row before
    cdef double[:, ::1] base  # estimates of the observer, about which the model is linearised
    cdef double[:, ::1] own  # standard deviations of its z and d; of a self-tuning observer
    cdef double[:, ::1] deviation  # delta of D 24, predicted from the rows before
    cdef double[:, :, ::1] covariance  # P of the predicted deviation
    cdef double[:, :, ::1] transition  # F from the row before; 0 where a row begins
    cdef look_at(self, dict columns)
    cdef make_room(self, Py_ssize_t more)
    cdef enter(self)
    cdef void forward(self, Py_ssize_t k) noexcept nogil
    cdef void begin(self, Py_ssize_t k, double y) noexcept nogil
    cdef void doubt(self, Py_ssize_t k) noexcept nogil
    cdef void predict(self, Py_ssize_t k) noexcept nogil
    cdef void step(self, Py_ssize_t k, double h, double* x, Row* slope) noexcept nogil
    cdef void change_model(self, Py_ssize_t k, double* x, Row* f, Row* p) noexcept nogil
    cdef void jump(self, Py_ssize_t k) noexcept nogil
    cdef void measure(self, Py_ssize_t k) noexcept nogil
    cdef void allow_jump(self, Py_ssize_t k, double missing) noexcept nogil
    cdef void turn_back(self, Py_ssize_t k, bint is_last, Row* a) noexcept nogil
    cdef void go_back(
        self, Py_ssize_t last, Py_ssize_t stop, Py_ssize_t top, double* out
    ) noexcept nogil
    cdef void write(
        self, Py_ssize_t k, const double* costate, const Row* known, double* out
    ) noexcept nogil
    cdef room(self, Py_ssize_t rows)
