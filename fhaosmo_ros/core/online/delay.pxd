# SPDX-License-Identifier: Apache-2.0
"""The known inputs within the delay of y."""

from fhaosmo_ros.core.model.prediction cimport Prediction
from fhaosmo_ros.core.observer.structure cimport MOST_INPUTS

cdef double NANOSECONDS  # s in a ns


cdef struct Ring:
    int past_place  # of the latest piece
    int past_count  # of pieces


cdef class PastInputs:
    cdef int inputs  # known inputs m
    cdef bint is_late  # y is known later than they are, so that the ring has pieces
    cdef readonly object latest  # (m,) array: inputs at the latest sample that was used
    cdef double* present  # the numbers of `latest`
    cdef double acting[MOST_INPUTS]  # inputs of the latest step: a mean
    # A ring of pieces, where y is known later than the inputs.
    cdef readonly object pieces  # (MOST_PIECES, 1 + m) array: a duration (ns), and inputs
    cdef double* first  # the first piece
    cdef readonly Ring ring
    cdef double* piece(self, int back) noexcept nogil
    cdef void note(self, long long elapsed, const double* u) noexcept nogil
    cdef void withdraw(self, long long elapsed) noexcept nogil
    cdef const double* before(
        self, long long lag, long long elapsed, const double* u
    ) noexcept nogil
    cdef void carry(self, Prediction prediction, long long lag, long long delay) noexcept nogil
