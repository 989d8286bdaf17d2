# SPDX-License-Identifier: Apache-2.0
"""The members as filters: prediction and correction, and jumps of d (D 27, D 33)."""

from fhaosmo_ros.core.observer.self_tuning.members cimport Members
from fhaosmo_ros.core.vectors cimport VECTORISED

cdef double EXACT, HUBER, INEXACT

cdef VECTORISED predict_states(
    Members* m, double h, const double* mean, const double* predicted
) noexcept nogil
cdef VECTORISED expect(Members* m, double h, double y) noexcept nogil
cdef VECTORISED allow_jump(Members* m, double y, double tau) noexcept nogil
cdef VECTORISED correct(Members* m, bint by_interval) noexcept nogil
cdef VECTORISED correct_states(Members* m, double y) noexcept nogil
