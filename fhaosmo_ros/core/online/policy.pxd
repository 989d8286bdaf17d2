# SPDX-License-Identifier: Apache-2.0
"""The policy of time and of bad data: one function for node, replay and trials."""

from fhaosmo_ros.core.observer.self_tuning.observer cimport SelfTuning
from fhaosmo_ros.core.observer.structure cimport Structure
from fhaosmo_ros.core.online.delay cimport PastInputs
from fhaosmo_ros.core.online.memory cimport Clock, Counters, Course, Sensor, Settings


cdef class Policy:
    cdef readonly Structure structure  # the observer; another one after a live change
    cdef SelfTuning tuner  # the same, where it is self-tuning, else None
    cdef readonly Settings settings
    cdef public Counters counters
    cdef readonly Course course
    cdef Clock clock
    cdef Sensor sensor
    cdef readonly PastInputs past

    # For whoever feeds it samples.
    cdef int take(self, long long stamp, double y, const double* u) noexcept nogil
    cdef void carry(self, double* out) noexcept nogil
    cdef void forget_samples(self) noexcept nogil
    # Its parts.
    cdef int judge(self, long long stamp, long long now, double y) noexcept nogil
    cdef long long since_latest(self, long long now, double y, int* word) noexcept nogil
    cdef long long settle(
        self, long long now, long long elapsed, double y, int* word
    ) noexcept nogil
    cdef int step_to(self, long long elapsed, double y, const double* u) noexcept nogil
    cdef int step_over(self, long long elapsed, double y, const double* u) noexcept nogil
    cdef bint has_diverged(self, bint failed, long long now) noexcept nogil
    cdef long long max_gap(self) noexcept nogil
    cdef long long max_late(self) noexcept nogil
    cdef int begin_again(self, long long* counter) noexcept nogil
    cdef void forget_clock(self, long long now) noexcept nogil
    cdef void update_mean(self, long long elapsed) noexcept nogil
    cdef void refresh(self) noexcept nogil
    cdef void check(self, Py_ssize_t inputs) except *
