# SPDX-License-Identifier: Apache-2.0
"""The first samples, and members that begin with what these tell (D 26, D 28)."""

from fhaosmo_ros.core.observer.self_tuning.members cimport Members

cdef void gather(Members* m) noexcept nogil
