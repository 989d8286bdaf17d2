# SPDX-License-Identifier: Apache-2.0
"""Unknown inputs d(t) of a simulated plant."""

cdef enum Kind:
    NONE, SINE, STEP, SQUARE, CHIRP


cdef class Disturbance:
    cdef double at(self, double t) noexcept nogil


cdef class Wave(Disturbance):
    cdef Kind kind
    cdef double amplitude  # of the wave, or height of the step (unit of d)
    cdef double omega  # angular frequency; a chirp's at t = 0 (rad/s)
    cdef double offset  # added to it (unit of d)
    cdef double start  # time of the step (s)


cdef class Table(Disturbance):
    cdef double spacing  # of its values (s)
    cdef double[::1] values  # from t = 0 on, at least 2 (unit of d)
