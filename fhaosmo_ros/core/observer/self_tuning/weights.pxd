# SPDX-License-Identifier: Apache-2.0
"""The members begin; how likely each of them is, and the mean of all (D 28, D 34)."""

from fhaosmo_ros.core.observer.self_tuning.members cimport Members
from fhaosmo_ros.core.vectors cimport VECTORISED


cdef struct Model:
    # The likeliest model of d (D 26, D 34); all 0 before the members have begun.
    double noise  # variance of the noise, if it were white
    double drive  # q
    double loss  # kappa (1/s)
    double derivatives  # k; k - 4 where d has jumped (D 33)


cdef double FLOOR, KEPT

cdef void gather(Members* m) noexcept nogil
cdef VECTORISED judge(Members* m, bint counts) noexcept nogil
cdef VECTORISED weigh(Members* m) noexcept nogil
cdef VECTORISED mix(Members* m, double* mean, double* variances) noexcept nogil
cdef void tell_model(Members* m, bint jumped, Model* model) noexcept nogil
cdef void find_tuning(Members* m, double* found) noexcept nogil
