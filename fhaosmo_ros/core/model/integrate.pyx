# SPDX-License-Identifier: Apache-2.0
"""
The one Runge-Kutta integrator, with its methods as tables of numbers.

Prediction, plant, and the simulation of plant and observer together are a `Dynamics` each. Bogacki
and Shampine 1989, doi:10.1016/0893-9659(89)90079-7.
"""

EULER = Method(1, [0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
BOGACKI_SHAMPINE = Method(3, [0.0, 0.5, 0.75, 0.0], [2.0 / 9.0, 1.0 / 3.0, 4.0 / 9.0, 0.0])
CLASSICAL = Method(4, [0.0, 0.5, 0.5, 1.0], [1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0])


cdef class Dynamics:
    """A system x' = f(t, x) of at most 96 states; others implement `rates`."""

    cdef void rates(self, int stage, double t, const double* x, double* slope) noexcept nogil:
        """Write f(t, x) to `slope`; `stage` is 0 at the beginning of a step."""


cdef void take_step(
    Dynamics system, const Method* method, double t, double h, double* x
) noexcept nogil:
    """Go from x(t) to x(t + h), in place."""
    cdef double point[MOST_STATES]
    cdef double slope[MOST_STATES]
    cdef double total[MOST_STATES]
    cdef int stage, i, size = system.size
    cdef double share, reach
    for i in range(size):
        point[i] = total[i] = x[i]
    for stage in range(method.stages):
        system.rates(stage, t + method.node[stage] * h, point, slope)
        share = h * method.weight[stage]
        for i in range(size):
            total[i] += share * slope[i]
        if stage + 1 < method.stages:
            reach = h * method.node[stage + 1]
            for i in range(size):
                point[i] = x[i] + reach * slope[i]
    for i in range(size):
        x[i] = total[i]
