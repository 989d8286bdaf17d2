# SPDX-License-Identifier: Apache-2.0
"""What the two structures with fixed gains share: psi, the law of gamma, and the start."""

from fhaosmo_ros.core.model.phi cimport Dual
from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.kalman cimport LinearModel, Row
from fhaosmo_ros.core.observer.structure cimport Level, Memory, Structure


# Seconds since the start where it does not matter when it was (D 20).
cdef double LONG_AGO
# Newton's method for eps ends at such a relative change; its square, 1e-15, is the error left.
cdef int NEWTON_STEPS
cdef double NEWTON_TOLERANCE
# Innovations below this are taken for 0: their powers would underflow.
cdef double TINY
# Innovations of more standard deviations count as so many (Huber 1964).
cdef double HUBER


cdef struct Gains:
    double lambda_  # of the power |eps|^gamma
    double alpha  # of the integrated psi
    double inverse_width  # 1 / half-width of psi (1 / unit of y)
    double decay  # rate of the internal state, if that is of d or a derivative of it (1/s)


cdef class SlidingMode(Structure):
    # What the parameters say.
    cdef readonly bint is_sign  # psi is sign
    cdef readonly bint adaptive  # gamma adapts
    cdef readonly bint sensitive  # sensitivities are carried along
    cdef readonly bint scheduled  # gains follow P at first; with levant also after gaps (D 20)
    cdef Gains gains[MOST_LEVELS]
    cdef const double[:, ::1] table  # psi of each level at `knots` points of [0, half-width]
    cdef const double* curves  # its numbers
    cdef int knots
    cdef Level first[MOST_LEVELS]  # levels of a fresh observer
    cdef double gamma_initial, gamma_rate, gamma_min  # law of gamma (D 7)
    cdef double dead_zone  # no adaptation while sqrt(L) is smaller (D 8, unit of y)
    cdef double leakage  # of gamma, towards gamma_initial (1/s)
    # For scheduled gains (D 20).
    cdef LinearModel linear
    cdef double noise_variance  # of the noise on y
    cdef Row fresh[MOST_LEVELS]  # P of a fresh observer
    cdef void follow(self, double y, double h, const double* u) noexcept nogil
    cdef int adapt(self, double h) noexcept nogil
    cdef void predict_levels(self, double h, const double* u) noexcept nogil
    cdef double bandwidth(self, double h) noexcept nogil
    cdef void correct_covariance(self, double doubt) noexcept nogil


cdef double doubt_of_noise(double age, double speed) noexcept nogil
cdef double spread_after(double spread, double b, double expected) noexcept nogil
cdef double follow_spread(Memory* memory, double b, double expected, double late) noexcept nogil


cdef inline Dual psi(SlidingMode law, int i, double a) noexcept nogil:
    """Return psi_i at a = |eps| >= 0 and its slope; psi is odd, so negative eps need no more."""
    cdef int last = law.knots - 1, j
    cdef const double* curve = law.curves + i * law.knots
    cdef double scale, position, rise
    if law.is_sign:
        return Dual(1.0, 0.0)
    scale = law.gains[i].inverse_width * last
    position = a * scale
    if not position < last:
        return Dual(curve[last], 0.0)
    j = <int>position
    rise = curve[j + 1] - curve[j]
    return Dual(curve[j] + (position - j) * rise, rise * scale)
