# SPDX-License-Identifier: Apache-2.0
"""
Plant and observer as one system of differential equations, integrated with a fixed step.

This is how the paper simulates: in continuous time, the observer sees y = z_1 at every stage of
the solver, which is called ode3 in fixed-step simulators. Its rates are those of its explicit
scheme (D 2 to D 7 in docs/mathematics.md).
"""

from libc.math cimport fmax, fmin
from libc.string cimport memcpy, memset

from fhaosmo_ros.core.model.prediction cimport Dynamics, MOST_LEVELS
from fhaosmo_ros.core.observer.sliding_mode cimport SlidingMode
from fhaosmo_ros.core.observer.structure cimport Level, MOST_INPUTS

from typing import NamedTuple

from fhaosmo_ros.core.model.inputs import Floats
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.observer import make_structure
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.plant import Plant
import numpy as np


# Bogacki and Shampine 1989, doi:10.1016/0893-9659(89)90079-7.
# Of the three stages of a step: when each is evaluated, and the weight of its slope.
cdef double[3] NODE = [0.0, 0.5, 0.75]
cdef double[3] WEIGHT = [2.0 / 9.0, 1.0 / 3.0, 4.0 / 9.0]


class JointRun(NamedTuple):
    """Truth and estimates on one time grid, as (K, ...) arrays."""

    t: Floats  # s
    z: Floats  # states of the plant
    unknown_input: Floats  # d
    z_hat: Floats  # filtered states
    gamma: Floats


cdef struct State:
    # Of plant and observer, or the rates of all that: an array of doubles with names.
    double gamma  # adaptive power
    double z[MOST_LEVELS]  # states of the plant
    Level level[MOST_LEVELS]  # of the observer


cdef class Joint:
    """A plant, and an observer of the explicit scheme, from their initial states; u = 0."""

    cdef Dynamics plant
    cdef SlidingMode observer
    cdef double u[MOST_INPUTS]  # known inputs: 0
    cdef State state
    cdef int size  # doubles of a state that are in use

    def __init__(self, Dynamics plant not None, configuration):
        cdef SlidingMode observer = make_structure(configuration)
        cdef double[::1] states = plant.states
        cdef int i
        self.plant, self.observer = plant, observer
        self.size = (sizeof(State) - sizeof(self.state.level)) // sizeof(double)
        self.size += observer.levels * (sizeof(Level) // sizeof(double))
        for i in range(plant.size):
            self.state.z[i] = states[i]
        self.state.level = observer.level
        if observer.from_measurement:
            self.state.level[0].z_hat = self.state.z[0]
        self.state.gamma = observer.memory.gamma

    cdef void rates(self, double t, const double* x, double* slope) noexcept nogil:
        """Write the rates of plant, levels and gamma."""
        cdef const State* now = <const State*>x
        cdef State* rate = <State*>slope
        cdef Level* after
        cdef int i
        memset(rate, 0, self.size * sizeof(double))
        self.plant.rates(t, now.z, rate.z)
        # A forward Euler step of length 1 moves the levels by their rates.
        memcpy(self.observer.level, now.level, self.observer.levels * sizeof(Level))
        self.observer.memory.gamma, self.observer.memory.y = now.gamma, now.z[0]
        self.observer.follow(now.z[0], 1.0, self.u)
        for i in range(self.observer.levels):
            after = &self.observer.level[i]
            rate.level[i].z_hat = after.z_hat - now.level[i].z_hat
            rate.level[i].z_tilde = after.z_tilde - now.level[i].z_tilde
            rate.level[i].p = after.p - now.level[i].p
            rate.level[i].q = after.q - now.level[i].q
        if self.observer.adaptive:
            rate.gamma = self.gamma_rate(self.observer, now.gamma)

    cdef void step(self, double t, double h) noexcept nogil:
        """Go on by `h`; a stage starts from the slope of the one before alone."""
        cdef State start = self.state, point = self.state, slope
        cdef double* total = <double*>&self.state
        cdef int stage, i
        for stage in range(3):
            self.rates(t + NODE[stage] * h, <double*>&point, <double*>&slope)
            for i in range(self.size):
                total[i] += h * WEIGHT[stage] * (<double*>&slope)[i]
                if stage < 2:
                    (<double*>&point)[i] = (
                        (<double*>&start)[i] + h * NODE[stage + 1] * (<double*>&slope)[i]
                    )

    cdef double gamma_rate(self, SlidingMode law, double gamma) noexcept nogil:
        """Return the rate of gamma by the law of D 7 and D 8, for the latest L."""
        cdef bint rests = law.loss <= law.dead_zone * law.dead_zone
        cdef double rate = 0.0
        if law.dead_zone == 0.0 or rests:
            rate -= law.leakage * (gamma - law.gamma_initial)
        if not rests:
            rate -= law.gamma_rate * law.gradient  # P adaptationlawgamma
        return rate

    def run(self, double h, Py_ssize_t count, int every):
        """Integrate and return `count` states, every `every`-th one, from the first one on."""
        cdef SlidingMode law = self.observer
        cdef int n = self.plant.size, levels = self.observer.levels, i, _
        cdef Py_ssize_t row, step = 0
        cdef double[:, ::1] z = np.empty((count, n))
        cdef double[:, ::1] z_hat = np.empty((count, levels))
        cdef double[::1] gamma = np.empty(count)
        with nogil:
            for row in range(count):
                for _ in range(every if row > 0 else 0):
                    self.step(step * h, h)
                    if law.adaptive:  # D 8
                        self.state.gamma = fmin(fmax(self.state.gamma, law.gamma_min), 1.0)
                    step += 1
                for i in range(n):
                    z[row, i] = self.state.z[i]
                for i in range(levels):
                    z_hat[row, i] = self.state.level[i].z_hat
                gamma[row] = self.state.gamma
        return np.asarray(z), np.asarray(z_hat), np.asarray(gamma)


def simulate(observer, plant, step=1e-3, duration=20.0, every=1):
    """
    Integrate plant and observer from their initial states over `duration` (s).

    `observer` and `plant` are parameters as for `Observer` and `Plant`, with fixed gains; scheme,
    noise and integration_step play no part. Records every `every`-th step.
    """
    own = {'scheme': 'explicit', 'noise_size': 0.0}  # a solver has no scheme of its own
    configuration = ObserverConfiguration(OBSERVER_PARAMETERS.complete(observer).changed(own))
    plant = Plant(plant)
    rows = round(duration / step) // every + 1
    z, z_hat, gamma = Joint(plant._system, configuration).run(step, rows, every)
    t = np.arange(rows, dtype=np.float64) * (every * step)
    return JointRun(t, z, plant._d.along(t), z_hat, gamma)
