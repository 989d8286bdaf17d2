# SPDX-License-Identifier: Apache-2.0
"""What a run of samples records."""

from fhaosmo_ros.core.observer.structure cimport Structure


cdef class Record:
    # What a run records, a row for each recorded sample, as `Trajectory` says.
    cdef readonly dict columns  # the same by name
    cdef double[:, ::1] z, innovation, z_hat, z_tilde, standard_deviation, model, tuning
    cdef double[::1] unknown_input, gamma
    cdef long long[::1] status, open_levels
    cdef void write(self, Structure structure, Py_ssize_t row, int word) noexcept nogil
