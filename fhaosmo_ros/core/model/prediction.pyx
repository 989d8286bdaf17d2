# SPDX-License-Identifier: Apache-2.0
"""
A triangular model alone: what it says of the time between two samples (D 1, D 17).

Whoever predicts writes the state to `z` and a direction to `dz`, calls `over`, and finds both at
the end of the interval: the estimate there, and its exact derivative in that direction.
"""

from libc.math cimport ceil

from fhaosmo_ros.core.model.integrate cimport CLASSICAL, Dynamics, take_step
from fhaosmo_ros.core.model.phi cimport Dual, Expressions, evaluate

cdef int MOST_STEPS = 4000  # of one prediction: bounds what a sample may cost


cdef class Prediction(Dynamics):
    """
    A triangular model and a point that moves along it.

    Parameters
    ----------
    phi : Expressions
        Phi_1 .. Phi_n, and the model of the unknown input behind them.
    longest : float
        Longest Runge-Kutta step (s).

    """

    def __cinit__(self, Expressions phi not None, double longest):
        if phi.count > MOST_LEVELS:
            raise ValueError(f'expected at most {MOST_LEVELS} states, got {phi.count}')
        self.phi, self.n, self.longest = phi, phi.count, longest
        self.size = 2 * self.n
        self.z, self.dz = self.x, self.x + self.n

    def __reduce__(self):
        return Prediction, (self.phi, self.longest)

    cdef void rates(self, int stage, double t, const double* x, double* slope) noexcept nogil:
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
        take_step(self, &CLASSICAL, 0.0, h, self.x)

    cdef void over(self, double h, const double* u) noexcept nogil:
        """Go on by `h` in equal steps of at most `longest`."""
        cdef int _, count = 1
        if h > self.longest:
            count = <int>min(ceil(h / self.longest * (1.0 - 1e-9)), MOST_STEPS)
        for _ in range(count):
            self.step(h / count, u)
