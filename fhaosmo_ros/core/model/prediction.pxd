# SPDX-License-Identifier: Apache-2.0
"""The one Runge-Kutta integrator, and a triangular model alone between two samples (D 1, D 17)."""

from fhaosmo_ros.core.model.phi cimport Expressions

cdef enum:
    MOST_LEVELS = 17  # order <= 12, d and at most 3 derivatives of it, and coloured noise
    MOST_STATES = 2 * MOST_LEVELS  # of a system: a prediction has derivatives, too


cdef class Dynamics:
    # A system x' = f(t, x).
    cdef int size  # number of states, at most MOST_STATES
    cdef void rates(self, double t, const double* x, double* slope) noexcept nogil


cdef void take_step(Dynamics system, double t, double h, double* x) noexcept nogil


cdef class Prediction(Dynamics):
    cdef Expressions phi
    cdef int n  # states: z_1 .. z_n, d, ..
    cdef const double* u  # known inputs of the present interval
    cdef double longest  # step (s)
    # Where it is: z_1 .. z_n, d, .. and, behind them, their derivatives in some direction.
    cdef double x[2 * MOST_LEVELS]
    cdef double* z  # x
    cdef double* dz  # x + n
    cdef void step(self, double h, const double* u) noexcept nogil
    cdef void over(self, double h, const double* u) noexcept nogil
