# SPDX-License-Identifier: Apache-2.0
"""The noise of y, its quantum, and whether a sample is likely (D 29)."""

from fhaosmo_ros.core.observer.self_tuning.members cimport Members
from fhaosmo_ros.core.vectors cimport VECTORISED

cdef double APART, FADED, LATTICE_SHARE, ROUGH, ROUNDED, STEADY

cdef void follow_quantum(Members* m) noexcept nogil
cdef double rounding(Members* m) noexcept nogil
cdef double bound_of_noise(Members* m, int colour, int order) noexcept nogil
cdef bint is_even(Members* m) noexcept nogil
cdef double usual_speed(Members* m) noexcept nogil
cdef void follow_differences(Members* m, double y, double h) noexcept nogil
cdef void follow_usual_interval(Members* m, double passed) noexcept nogil
cdef void follow_stamps(Members* m, double interval, double change) noexcept nogil
cdef VECTORISED fill_noise(Members* m) noexcept nogil
cdef VECTORISED find_knowing(Members* m, bint unlikely_before) noexcept nogil
cdef bint is_likely(Members* m, double gate, double late) noexcept nogil
cdef VECTORISED follow_noise(Members* m) noexcept nogil
cdef double find_noise(Members* m) noexcept nogil
