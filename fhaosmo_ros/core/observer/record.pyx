# SPDX-License-Identifier: Apache-2.0
"""What a run of samples records."""

from fhaosmo_ros.core.observer.status cimport FLAGS_MASK, LEVEL_SHIFT
from fhaosmo_ros.core.observer.structure cimport Structure

import numpy as np


cdef class Record:
    """
    What a run records: a row for each recorded sample, as arrays in `columns`.

    Parameters
    ----------
    structure : Structure
    rows : int

    """

    def __cinit__(self, Structure structure not None, Py_ssize_t rows):
        cdef int n = structure.levels
        tunes = structure.configuration.self_tuning
        self.z_hat, self.z_tilde = np.empty((rows, n)), np.empty((rows, n))
        self.innovation, self.gamma = np.empty((rows, n)), np.empty(rows)
        self.variance = np.empty((rows, structure.order + 1 if tunes else 0))
        self.model = np.empty((rows, 4 if tunes else 0))
        self.tuning = np.empty((rows, 7 if tunes else 0))
        self.words = np.empty(rows, dtype=np.int64)

    cdef void write(self, Structure structure, Py_ssize_t row, int word) noexcept nogil:
        """Record what an observer knows."""
        cdef int i
        for i in range(structure.levels):
            self.z_hat[row, i] = structure.level[i].z_hat
            self.z_tilde[row, i] = structure.level[i].z_tilde
            self.innovation[row, i] = structure.innovation[i]
        for i in range(<int>self.variance.shape[1]):
            self.variance[row, i] = structure.variance(i)
        if self.model.shape[1] > 0:
            structure.tell(&self.model[row, 0], &self.tuning[row, 0])
        self.gamma[row] = structure.memory.gamma
        self.words[row] = word

    @property
    def columns(self):
        """Arrays by name: z_hat, z_tilde, innovation, variance, model, tuning, gamma, words."""
        return {
            'z_hat': np.asarray(self.z_hat),
            'z_tilde': np.asarray(self.z_tilde),
            'innovation': np.asarray(self.innovation),
            'variance': np.asarray(self.variance),
            'model': np.asarray(self.model),
            'tuning': np.asarray(self.tuning),
            'gamma': np.asarray(self.gamma),
            'words': np.asarray(self.words),
        }


def run(
    Structure structure not None, const double[::1] y, const double[::1] h,
    const double[:, ::1] u, Py_ssize_t first, Py_ssize_t every
):
    """
    Start with the samples before index `first`, step from it on; record every `every`-th one.

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
            if k >= first:
                word = structure.step(y[k], h[k], &u[k, 0])
            else:
                word = structure.start(y[k])
            seen |= word & FLAGS_MASK
            if (k + 1) % every == 0:
                record.write(structure, row, (word >> LEVEL_SHIFT << LEVEL_SHIFT) | seen)
                seen = 0
                row += 1
            structure.word = word
    structure.busy = False
    return record
