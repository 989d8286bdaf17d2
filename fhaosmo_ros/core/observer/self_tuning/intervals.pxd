# SPDX-License-Identifier: Apache-2.0
"""The members where y is quantised: a sample is an interval of z_1 (D 31, D 36)."""

from fhaosmo_ros.core.observer.self_tuning.members cimport Members
from fhaosmo_ros.core.vectors cimport VECTORISED

cdef VECTORISED take_interval(Members* m) noexcept nogil
cdef bint choose_members(Members* m) noexcept nogil
