# SPDX-License-Identifier: Apache-2.0
"""The simulated plant as differential equations (paper eq. newsimpledynamics), and its d(t)."""

from fhaosmo_ros.core.model.phi cimport Expressions
from fhaosmo_ros.core.model.prediction cimport Dynamics, MOST_LEVELS

cdef enum Kind:
    NONE, SINE, STEP, SQUARE, CHIRP, TABLE


cdef class Disturbance:
    cdef Kind kind
    cdef double amplitude  # of the wave, or height of the step (unit of d)
    cdef double omega  # angular frequency; a chirp's at t = 0 (rad/s)
    cdef double offset  # added to it (unit of d)
    cdef double start  # time of the step (s)
    cdef double spacing  # of the values of a table (s)
    cdef const double[::1] values  # from t = 0 on, at least 2 (unit of d)
    cdef double at(self, double t) noexcept nogil


cdef class System(Dynamics):
    cdef Expressions phi
    cdef Disturbance d
    cdef double h  # longest step (s)
    cdef const double* u  # known inputs of the present interval
    cdef const double[::1] held  # and of the latest one
    cdef double t  # time that it has come to (s)
    cdef double z[MOST_LEVELS]  # z_1 .. z_n then
    cdef void go_to(self, double t) noexcept nogil
