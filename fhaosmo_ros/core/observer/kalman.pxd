# SPDX-License-Identifier: Apache-2.0
"""The Kalman filter of a triangular model with a chain of integrators that makes d."""

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS

ctypedef double[MOST_LEVELS] Row  # of a matrix


cdef fill(Row* to, matrix)
cdef int sub_steps(double h, double fastest) noexcept nogil
cdef void carry(int n, const Row* f, Row* p) noexcept nogil
cdef void multiply(int n, const Row* f, Row* p) noexcept nogil
cdef void add_drive(int last, double intensity, double h, Row* p) noexcept nogil
cdef void correct(int n, Row* p, double variance) noexcept nogil
cdef double usual(int i, int j, double rate, double intensity) noexcept nogil


cdef class LinearModel:
    cdef int n  # states
    cdef Row rates[MOST_LEVELS]  # A of x' = A x (1/s), a lower Hessenberg matrix
    cdef readonly double intensity  # of the white noise that drives the last state
    cdef readonly double fastest  # rate of the fastest motion (1/s)
    cdef void flow(self, double h, Row* f) noexcept nogil
    cdef void predict(self, Row* p, double h) noexcept nogil
