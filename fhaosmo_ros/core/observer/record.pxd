# SPDX-License-Identifier: Apache-2.0
"""What a run of samples records."""

from fhaosmo_ros.core.observer.structure cimport Structure


cdef class Record:
    # What a run records, a row for each recorded sample.
    cdef double[:, ::1] z_hat, z_tilde, innovation  # (rows, N)
    cdef double[:, ::1] variance  # (rows, n + 1), of a self-tuning observer; (rows, 0) of others
    cdef double[:, ::1] model  # (rows, 4) or (rows, 0): the likeliest model of d
    cdef double[:, ::1] tuning  # (rows, 7) or (rows, 0): what it has found
    cdef double[::1] gamma  # (rows,)
    cdef long long[::1] words  # (rows,), status words
    cdef void write(self, Structure structure, Py_ssize_t row, int word) noexcept nogil
