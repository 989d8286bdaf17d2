# SPDX-License-Identifier: Apache-2.0
"""Levant's arbitrary-order differentiator with the paper's curves and power."""

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.kalman cimport Row
from fhaosmo_ros.core.observer.sliding_mode cimport SlidingMode
from fhaosmo_ros.core.observer.structure cimport Memory


# Innovations of more standard deviations count as so many, at most (D 32).
cdef double HUBER


cdef double follow_spread(Memory* memory, double b, double expected) noexcept nogil


cdef struct Root:
    double eps  # |eps| >= 0
    double w  # |eps|^(2 gamma / N)
    double s  # of the last level, which is set-valued for sign


cdef class Levant(SlidingMode):
    cdef double widest  # half-width (unit of y); growth begins beyond it (D 22)
    cdef double relaxation  # at which the scale returns to 1 (1/s)
    cdef double share[MOST_LEVELS][MOST_LEVELS]  # beta of D 18; 1 for implicit
    cdef double ratio[MOST_LEVELS]  # factors of the corrections of the levels, P / steady P
    cdef double correction_period  # interval that the gains are tuned for (s); 0: any
    # For scheduled gains (D 20).
    cdef double steady_variance  # of the innovations once P is steady
    cdef Row steady[MOST_LEVELS]  # P of the predictions then
    cdef double tuned_over_kalman[MOST_LEVELS]  # corrections of a small innovation
    cdef double next_size[MOST_LEVELS]  # sizes of z_2 .. z_n, d
    cdef void backward(self, double y, double h, const double* u) noexcept nogil
    cdef void predict_correct(self, double y, double h, const double* u) noexcept nogil
    cdef void correct_levels(self, double y, double h) noexcept nogil
    cdef Root root(self, const double* weight, double b, double gamma) noexcept nogil
    cdef void grow(self, double a, double h) noexcept nogil
    cdef double influence(self, double b, double usual) noexcept nogil
