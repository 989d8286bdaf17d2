# SPDX-License-Identifier: Apache-2.0
"""The simulated plant as differential equations (paper eq. newsimpledynamics), and its d(t)."""

from libc.math cimport ceil, fmax, fmin, sin
from libc.string cimport memcpy

from fhaosmo_ros.core.model.phi cimport Expressions, evaluate
from fhaosmo_ros.core.model.prediction cimport Dynamics, MOST_LEVELS, take_step

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

# A chirp sweeps over so many times its first angular frequency, within this time (s).
cdef double SWEEP = 10.0
cdef double SWEEP_TIME = 20.0
cdef double[MOST_LEVELS] STILL  # direction of a derivative that nobody needs: 0
KINDS = ('none', 'sine', 'step', 'square', 'chirp')

cdef enum Kind:
    NONE, SINE, STEP, SQUARE, CHIRP, TABLE


cdef class Disturbance:
    """
    A function d(t) of the time since the plant's start (s).

    It is the wave that checked parameters of a plant say; or a table: `values`, (M,), M >= 2, at
    0, `spacing`, ... (s), linear in between and constant behind the last one.
    """

    cdef Kind kind
    cdef double amplitude  # of the wave, or height of the step (unit of d)
    cdef double omega  # angular frequency; a chirp's at t = 0 (rad/s)
    cdef double offset  # added to it (unit of d)
    cdef double start  # time of the step (s)
    cdef double spacing  # of the values of a table (s)
    cdef const double[::1] values  # from t = 0 on, at least 2 (unit of d)

    def __cinit__(self, p, values=None, double spacing=1.0):
        self.spacing = spacing
        if values is not None:
            self.kind, self.values = TABLE, np.array(values, dtype=np.float64)
            if len(self.values) < 2 or not spacing > 0.0:
                raise ValueError('table of d: expected at least 2 values and a spacing > 0')
            return
        self.kind = KINDS.index(p['disturbance'])
        self.amplitude, self.offset = p['disturbance_amplitude'], p['disturbance_offset']
        self.omega, self.start = p['disturbance_omega'], p['disturbance_start']

    cdef double at(self, double t) noexcept nogil:
        """Return d(t)."""
        cdef double angle = self.omega * t, last = SWEEP * self.omega, swept, wave, position
        cdef Py_ssize_t j, end
        if self.kind == NONE:
            return 0.0
        if self.kind == TABLE:
            position, end = t / self.spacing, self.values.shape[0] - 1
            if not position < end:
                return self.values[end]
            if not position >= 0.0:
                return self.values[0]
            j = <Py_ssize_t>position
            return self.values[j] + (position - j) * (self.values[j + 1] - self.values[j])
        if self.kind == STEP:
            return self.offset + (self.amplitude if t >= self.start else 0.0)
        if self.kind == CHIRP:
            swept = fmin(t, SWEEP_TIME)
            angle = (
                self.omega * swept
                + 0.5 * (last - self.omega) / SWEEP_TIME * swept * swept
                + last * (t - swept)
            )
        wave = sin(angle)
        if self.kind == SQUARE:
            wave = 1.0 if wave >= 0.0 else -1.0
        return self.offset + self.amplitude * wave

    def along(self, t):
        """Return d, (K,), at times `t` (s), (K,) or a number."""
        return np.array([self.at(time) for time in np.ravel(t)], dtype=np.float64)


cdef class System(Dynamics):
    """
    A triangular system that d drives, integrated by the classical Runge-Kutta method.

    `phi` are Phi_1 .. Phi_n, `h` is the longest step (s), and `z`, (n,), are the states at t = 0.
    """

    cdef Expressions phi
    cdef Disturbance d
    cdef double h  # longest step (s)
    cdef const double[::1] held  # known inputs of the latest interval
    cdef double t  # time that it has come to (s)
    cdef double z[MOST_LEVELS]  # z_1 .. z_n then

    def __cinit__(self, Expressions phi not None, Disturbance d not None, double h, z):
        cdef int i
        self.size, self.h = phi.count, h
        if phi.states > self.size or self.size > MOST_LEVELS or len(z) != self.size or not h > 0.0:
            raise ValueError(f'expected {phi.count} <= {MOST_LEVELS} states and a step > 0')
        self.phi, self.d = phi, d
        self.held = np.zeros(max(phi.inputs, 1))
        for i in range(self.size):
            self.z[i] = z[i]

    def change(self, Expressions phi not None, Disturbance d not None):
        """Go on with other functions of as many states and known inputs."""
        if phi.count != self.size or phi.states > self.size or phi.inputs != self.phi.inputs:
            raise ValueError(f'expected {self.size} states, and {self.phi.inputs} known inputs')
        self.phi, self.d = phi, d

    @property
    def states(self):
        """States at the time of the latest `advance`, (n,)."""
        return np.array([self.z[i] for i in range(self.size)])

    cdef void rates(self, double t, const double* x, double* slope) noexcept nogil:
        """Write z_i' = z_{i+1} + Phi_i(z, u), z_n' = d(t) + Phi_n(z, u)."""
        cdef int i, last = self.size - 1
        for i in range(self.size):
            slope[i] = x[i + 1] if i < last else self.d.at(t)
            slope[i] += evaluate(self.phi, i, x, STILL, &self.held[0]).value

    cdef void go_to(self, double t) noexcept nogil:
        """Bring `z` to `t` in equal steps of at most `h`; one that has passed is left out."""
        cdef double begin = self.t, step
        cdef long long j, count
        if not t > begin:
            return
        count = <long long>fmax(ceil((t - begin) / self.h - 1e-9), 1.0)
        step = (t - begin) / count
        self.t = t
        for j in range(count):
            take_step(self, begin + j * step, step, self.z)

    def advance(self, t, u):
        """
        Return the states at many times, (K, n).

        `t`, (K,) or a number, are times since t = 0 (s), finite and not decreasing; `u`, (K, m),
        are the known inputs of the interval that ends at each: a step has one value of each.
        """
        cdef const double[::1] times = np.ascontiguousarray(t, dtype=np.float64)
        cdef const double[:, ::1] inputs = u
        cdef Py_ssize_t k, count = times.shape[0]
        cdef double[:, ::1] states = np.empty((count, self.size))
        if inputs.shape[0] != count or inputs.shape[1] < self.phi.inputs:
            raise ValueError(f'expected known inputs of shape ({count}, m), got {np.shape(u)}')
        if inputs.shape[1] == 0:
            inputs = np.zeros((count, 1))
        if not (np.isfinite(times).all() and (np.diff(times) >= 0.0).all()):
            raise ConfigurationError('plant: expected finite times that rise or stay, got others')
        for k in range(count):
            self.held = inputs[k]
            self.go_to(times[k])
            memcpy(&states[k, 0], self.z, self.size * sizeof(double))
        return np.asarray(states)

    def go_on(self, double t):
        """Return z_1 at `t`, with the known inputs of the latest `advance`; in a microsecond."""
        self.go_to(t)
        return self.z[0]
