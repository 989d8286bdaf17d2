# SPDX-License-Identifier: Apache-2.0
"""
The one Runge-Kutta integrator, and a triangular model alone between two samples (D 1, D 17).

Prediction and plant are a `Dynamics` each.
"""

from libc.math cimport ceil

from fhaosmo_ros.core.model.phi cimport Dual, Expressions, evaluate

# Of the four stages of a step: when each is evaluated, and the weight of its slope.
cdef double[4] NODE = [0.0, 0.5, 0.5, 1.0]
cdef double[4] WEIGHT = [1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0]
cdef int MOST_STEPS = 4000  # of one prediction: bounds what a sample may cost


cdef class Dynamics:
    """A system x' = f(t, x) of at most 34 states; others implement `rates`."""

    cdef void rates(self, double t, const double* x, double* slope) noexcept nogil:
        """Write f(t, x) to `slope`."""


cdef void take_step(Dynamics system, double t, double h, double* x) noexcept nogil:
    """Go from x(t) to x(t + h) by the classical method of order 4, in place."""
    cdef double point[MOST_STATES]
    cdef double slope[MOST_STATES]
    cdef double total[MOST_STATES]
    cdef int stage, i, size = system.size
    for i in range(size):
        point[i] = total[i] = x[i]
    for stage in range(4):
        system.rates(t + NODE[stage] * h, point, slope)
        for i in range(size):
            total[i] += h * WEIGHT[stage] * slope[i]
            if stage < 3:
                point[i] = x[i] + h * NODE[stage + 1] * slope[i]
    for i in range(size):
        x[i] = total[i]


cdef class Prediction(Dynamics):
    """
    A triangular model and a point that moves along it.

    Whoever predicts writes the state to `z` and a direction to `dz`, calls `over`, and finds both
    at the end of the interval: the estimate there, and its exact derivative in that direction.
    `phi` has the model of the unknown input behind Phi_1 .. Phi_n.
    """

    def __cinit__(self, Expressions phi not None, double longest):
        if not phi.states <= phi.count <= MOST_LEVELS:
            raise ValueError(f'expected at most {MOST_LEVELS} states, got {phi.count}')
        self.phi, self.n, self.longest = phi, phi.count, longest
        self.size = 2 * self.n
        self.z, self.dz = self.x, self.x + self.n

    cdef void rates(self, double t, const double* x, double* slope) noexcept nogil:
        """Write the rates of P triangular and their derivatives."""
        cdef int i, n = self.n
        cdef Dual phi
        for i in range(n):
            phi = evaluate(self.phi, i, x, x + n, self.u)
            slope[i], slope[n + i] = phi.value, phi.slope
            if i + 1 < n:
                slope[i] += x[i + 1]
                slope[n + i] += x[n + i + 1]

    cdef void step(self, double h, const double* u) noexcept nogil:
        """Go on by `h` in one step of the classical Runge-Kutta method."""
        self.u = u
        take_step(self, 0.0, h, self.x)

    cdef void over(self, double h, const double* u) noexcept nogil:
        """Go on by `h` in equal steps of at most `longest`."""
        cdef int _, count = 1
        if h > self.longest:
            count = <int>min(ceil(h / self.longest * (1.0 - 1e-9)), MOST_STEPS)
        for _ in range(count):
            self.step(h / count, u)
