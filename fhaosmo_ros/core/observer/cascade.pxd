# SPDX-License-Identifier: Apache-2.0
"""The paper's observer, a cascade of super-twisting levels."""

from fhaosmo_ros.core.observer.sliding_mode cimport SlidingMode


cdef struct Root:
    double eps  # |eps| >= 0
    double s  # psi(eps), or what the set-valued sign takes


cdef class Cascade(SlidingMode):
    cdef void start_as_kalman(self, double y, double h, const double* u) noexcept nogil
    cdef void hand_over(self, const double* u) noexcept nogil
    cdef void explicit(self, double gamma, double y, double h, const double* u) noexcept nogil
    cdef void backward(self, double gamma, double y, double h, const double* u) noexcept nogil
    cdef Root root(self, int i, double b, double h, double gamma) noexcept nogil
