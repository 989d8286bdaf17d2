# SPDX-License-Identifier: Apache-2.0
"""What a run of samples records."""

from libc.math cimport isnan, sqrt

from fhaosmo_ros.core.observer.status cimport FLAGS_MASK, LEVEL_SHIFT
from fhaosmo_ros.core.observer.structure cimport Structure

import numpy as np


cdef class Record:
    """
    What a run records, a row for each recorded sample: arrays by the names of `Trajectory`.

    Parameters
    ----------
    structure : Structure
    rows : int

    """

    def __cinit__(self, Structure structure not None, Py_ssize_t rows):
        cdef int n = structure.levels
        tunes = structure.configuration.self_tuning
        widths = {
            'z': structure.order, 'innovation': n, 'z_hat': n, 'z_tilde': n,
            'standard_deviation': structure.order + 1 if tunes else 0,
            'model': 4 if tunes else 0, 'tuning': 7 if tunes else 0,
        }
        found = {name: np.empty((rows, width)) for name, width in widths.items()}
        found |= {name: np.empty(rows) for name in ('unknown_input', 'gamma')}
        found |= {name: np.empty(rows, dtype=np.int64) for name in ('status', 'open_levels')}
        self.columns = found
        self.z, self.unknown_input = found['z'], found['unknown_input']
        self.gamma, self.innovation = found['gamma'], found['innovation']
        self.status, self.open_levels = found['status'], found['open_levels']
        self.z_hat, self.z_tilde = found['z_hat'], found['z_tilde']
        self.standard_deviation = found['standard_deviation']
        self.model, self.tuning = found['model'], found['tuning']

    cdef void write(self, Structure structure, Py_ssize_t row, int word) noexcept nogil:
        """Record what an observer knows."""
        cdef int i
        for i in range(structure.levels):
            self.z_hat[row, i] = structure.level[i].z_hat
            self.z_tilde[row, i] = structure.level[i].z_tilde
            self.innovation[row, i] = structure.innovation[i]
        for i in range(structure.order):
            self.z[row, i] = structure.estimate(i)
        for i in range(<int>self.standard_deviation.shape[1]):
            self.standard_deviation[row, i] = sqrt(structure.variance(i))
        if self.model.shape[1] > 0:
            structure.tell(&self.model[row, 0], &self.tuning[row, 0])
        self.unknown_input[row] = structure.estimate(structure.order)
        self.gamma[row] = structure.memory.gamma
        self.status[row], self.open_levels[row] = word & FLAGS_MASK, word >> LEVEL_SHIFT


def run(
    Structure structure not None, const double[::1] y, const double[::1] h,
    const double[:, ::1] u, Py_ssize_t every
):
    """
    Start with samples until one is good, step from the next one on; record every `every`-th one.

    Row r of the record is the state after sample (r + 1) * every - 1; its flags are those of
    all samples since the row before it.

    Parameters
    ----------
    y, h : (K,) arrays
        Samples, and the time (s) of the interval that ends at each.
    u : (K, m) array
        Known inputs of that interval.

    """
    cdef Record record = Record(structure, y.shape[0] // every)
    cdef Py_ssize_t k, row = 0
    cdef int word, seen = 0
    if not (h.shape[0] == u.shape[0] == y.shape[0] and u.shape[1] == structure.inputs):
        raise ValueError('run: arrays of different lengths')
    structure.enter()
    structure.busy = True
    with nogil:
        for k in range(y.shape[0]):
            if isnan(structure.memory.y):
                word = structure.start(y[k])
            else:
                word = structure.step(y[k], h[k], &u[k, 0])
            seen |= word & FLAGS_MASK
            if (k + 1) % every == 0:
                record.write(structure, row, (word >> LEVEL_SHIFT << LEVEL_SHIFT) | seen)
                seen = 0
                row += 1
            structure.word = word
    structure.busy = False
    return record
