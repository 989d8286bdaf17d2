# SPDX-License-Identifier: Apache-2.0
"""The simulated plant as differential equations (paper eq. newsimpledynamics)."""

from fhaosmo_ros.core.model.integrate cimport Dynamics
from fhaosmo_ros.core.model.phi cimport Expressions
from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.simulation.disturbance cimport Disturbance


cdef class System(Dynamics):
    cdef Expressions phi
    cdef Disturbance d
    cdef double h  # step of the grid of time (s)
    cdef const double* u  # known inputs of the present interval
    cdef const double[::1] held  # and of the latest one
    cdef long long taken  # steps of the grid since t = 0
    cdef double on_grid[MOST_LEVELS]  # z_1 .. z_n then, at taken * h
    cdef double z[MOST_LEVELS]  # and at the time of the latest `advance`
    cdef void go_to(self, double t, const double* u) noexcept nogil
    cdef void go_evenly(self, double begin, double t, const double* u) noexcept nogil
