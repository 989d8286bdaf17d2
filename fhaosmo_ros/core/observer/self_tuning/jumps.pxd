# SPDX-License-Identifier: Apache-2.0
"""Jumps of d (D 33), and of y that are too small to be lost samples (D 35)."""

from fhaosmo_ros.core.observer.self_tuning.members cimport Members
from fhaosmo_ros.core.vectors cimport VECTORISED

cdef double SMOOTHEST

cdef void begin_growth(Members* m) noexcept nogil
cdef bint has_jumped(Members* m, double beyond) noexcept nogil
cdef VECTORISED allow_jump(Members* m, double tau) noexcept nogil
cdef void watch(Members* m, int member) noexcept nogil
cdef void follow_innovations(Members* m) noexcept nogil
cdef int samples_since_jump(Members* m) noexcept nogil
cdef void follow_jump(Members* m, int count) noexcept nogil
cdef void shift(Members* m, double of_state, double miss, double variance) noexcept nogil
