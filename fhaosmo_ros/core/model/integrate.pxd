# SPDX-License-Identifier: Apache-2.0
"""The one Runge-Kutta integrator, with its methods as tables of numbers."""

cdef enum:
    MOST_STAGES = 4
    MOST_STATES = 96  # of a system: plant and observer together have at most 12 + 4 * 16 + 1


cdef struct Method:
    # An explicit Runge-Kutta method; a stage starts from the slope of the one before alone.
    int stages
    double node[MOST_STAGES]  # when a stage is evaluated, as a part of the step
    double weight[MOST_STAGES]  # of its slope


cdef Method EULER  # order 1
cdef Method BOGACKI_SHAMPINE  # order 3
cdef Method CLASSICAL  # order 4


cdef class Dynamics:
    # A system x' = f(t, x).
    cdef int size  # number of states, at most MOST_STATES
    cdef void rates(self, int stage, double t, const double* x, double* slope) noexcept nogil


cdef void take_step(
    Dynamics system, const Method* method, double t, double h, double* x
) noexcept nogil
