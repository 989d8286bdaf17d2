# SPDX-License-Identifier: Apache-2.0
"""The self-tuning observer: members side by side, weighted by how well they predict y."""

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.self_tuning.members cimport Members
from fhaosmo_ros.core.observer.self_tuning.weights cimport Model
from fhaosmo_ros.core.observer.structure cimport Structure


cdef class SelfTuning(Structure):
    # What the parameters say.
    cdef bint is_linear  # the model
    # What it remembers.
    cdef void* block  # of memory, which holds the members
    cdef Members* members
    cdef Model model  # the likeliest model of d, which a smoother goes by (D 34)
    cdef double variances[MOST_LEVELS]  # of the errors of z, d, ..; infinite before it begins
    cdef bint y_jumped  # a sample tells that y has jumped (D 35)
    # A step's own.
    cdef Model trial_model
    cdef double trial_variances[MOST_LEVELS]
    # For the policy.
    cdef bint is_noisy(self, double y) noexcept nogil
    cdef void begin_afresh(self) noexcept nogil
    # Parts of a step.
    cdef void step_members(self, double y, double h, const double* u) noexcept nogil
    cdef double look(self, double y, double h, const double* u) noexcept nogil
    cdef bint may_have_waited(self, double change) noexcept nogil
    cdef void follow_usual_interval(self) noexcept nogil
    cdef bint is_stamped_late(
        self, double y, double h, const double* u, double gate
    ) noexcept nogil
    cdef double likelihood(self) noexcept nogil
    cdef void follow_period(self, double h, bint same) noexcept nogil
    cdef void carry_flow(self, double h, const double* u, bint same) noexcept nogil
    cdef void pass_over(self) noexcept nogil
    cdef void take_sample(self) noexcept nogil
    cdef bint has_begun(self) noexcept nogil
    # Snapshots.
    cdef dict places(self)
