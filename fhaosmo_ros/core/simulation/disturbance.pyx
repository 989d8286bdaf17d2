# SPDX-License-Identifier: Apache-2.0
"""Unknown inputs d(t) that the simulated plant can be given."""

from libc.math cimport fmin, sin

import numpy as np

# A chirp sweeps over so many times its first angular frequency, within this time (s).
cdef double SWEEP = 10.0
cdef double SWEEP_TIME = 20.0
KINDS = ('none', 'sine', 'step', 'square', 'chirp')


cdef class Disturbance:
    """A function d(t) of the time since the plant's start."""

    cdef double at(self, double t) noexcept nogil:
        """Return d(t)."""
        return 0.0

    def along(self, t):
        """Return d at times `t` (s), an array of their shape (K,)."""
        cdef const double[::1] times = np.ascontiguousarray(t, dtype=np.float64)
        cdef double[::1] d = np.empty(times.shape[0])
        cdef Py_ssize_t k
        for k in range(times.shape[0]):
            d[k] = self.at(times[k])
        return np.asarray(d)


cdef class Wave(Disturbance):
    """The d(t) of a plant with the parameters `p`, checked ones."""

    def __init__(self, p):
        self.kind = KINDS.index(p['disturbance'])
        self.amplitude, self.offset = p['disturbance_amplitude'], p['disturbance_offset']
        self.omega, self.start = p['disturbance_omega'], p['disturbance_start']

    cdef double at(self, double t) noexcept nogil:
        """Return d(t)."""
        cdef double angle = self.omega * t, last = SWEEP * self.omega, swept, wave
        if self.kind == NONE:
            return 0.0
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


cdef class Table(Disturbance):
    """
    Any d(t), linear between values at 0, `spacing`, ... and constant behind the last one.

    Parameters
    ----------
    values : (M,) array
        M >= 2.
    spacing : float
        Seconds, > 0.

    """

    def __init__(self, values, double spacing):
        self.values, self.spacing = np.array(values, dtype=np.float64), spacing
        if len(self.values) < 2 or not spacing > 0.0:
            raise ValueError('table of d: expected at least 2 values and a spacing > 0')

    def __reduce__(self):
        return Table, (np.asarray(self.values), self.spacing)

    cdef double at(self, double t) noexcept nogil:
        """Return d(t)."""
        cdef double position = t / self.spacing
        cdef Py_ssize_t j, last = self.values.shape[0] - 1
        if not position < last:
            return self.values[last]
        if not position >= 0.0:
            return self.values[0]
        j = <Py_ssize_t>position
        return self.values[j] + (position - j) * (self.values[j + 1] - self.values[j])
