# SPDX-License-Identifier: Apache-2.0
"""
The members of the self-tuning observer: which they are, and what they remember (D 26).

A member is an observer with its own model of d (D 17: k = 0, 1 or 3 derivatives, intensity q,
decay kappa) and of the noise (white, or coloured: v_j = a v_{j-1} + w_j). All have n + 4 states,
of which those of derivatives that a model does not have stay 0. Each quantity is a line of one
number a member, so that a step of all members is a few long loops that the compiler turns into
vector instructions. Members with white noise come first, from the quickest to the slowest; those
with coloured noise follow from the slowest to the quickest: where only slow members' covariances
move, theirs are neighbours.
"""

from libc.math cimport exp, log, sqrt

from fhaosmo_ros.core.vectors cimport VECTORISED

import numpy as np

SLOWEST, QUICKEST = 6e-4, 3.0  # range of the bandwidths (rad a sample)
DERIVATIVES = [0, 1, ORDERS - 1]  # k of the members of each bandwidth
cdef double DECAY = 0.1
cdef double BAND_STEP  # omega of a band over that of the next slower one
CORRELATIONS = [0.0, 0.75, 0.92, 0.98]  # a of the colours of the noise
COLOURED = [1, 3, 1, 2]  # of the members of four bandwidths in turn
cdef enum:
    LANES = 24  # numbers that are compared side by side


def fill_grid():
    """Write which the members are."""
    global BAND_STEP
    cdef int g, band
    BAND_STEP = (QUICKEST / SLOWEST) ** (1.0 / (BANDS - 1))
    bandwidths = np.geomspace(SLOWEST, QUICKEST, BANDS)
    for g in range(COUNT - 1, -1, -1):
        band = BANDS - 1 - g // IN_BAND if g < HALF else g // IN_BAND - BANDS
        GRID.band[g], GRID.bandwidth[g] = band, bandwidths[band]
        GRID.order[g] = DERIVATIVES[g % IN_BAND]
        GRID.white[g] = HALF - IN_BAND * (1 + band) + g % IN_BAND
        GRID.colour[g] = 0 if g < HALF else COLOURED[band % 4]
        GRID.first[GRID.colour[g]] = g
    for g in range(COLOURS):
        GRID.correlation[g] = CORRELATIONS[g]


fill_grid()


cdef VECTORISED fill(double* values, const double* of_colours) noexcept nogil:
    """Write for each member the value of its colour."""
    cdef Py_ssize_t g
    cdef double white = of_colours[0]
    for g in range(HALF):
        values[g] = white
    for g in range(HALF, HALF + 4 * IN_BAND):
        values[g] = of_colours[GRID.colour[g]]
    for g in range(HALF + 4 * IN_BAND, COUNT):  # the colours are those of four bands before
        values[g] = values[g - 4 * IN_BAND]


cdef double largest(const double* values, Py_ssize_t count) noexcept nogil:
    """Return the largest of `count` values, a multiple of LANES."""
    cdef double best[LANES]
    cdef Py_ssize_t k
    for k in range(LANES):
        best[k] = values[k]
    for _ in range(1, count // LANES):
        values += LANES
        for k in range(LANES):
            best[k] = values[k] if values[k] > best[k] else best[k]
    for k in range(1, LANES):
        best[0] = best[k] if best[k] > best[0] else best[0]
    return best[0]


cdef double factorial(int i) noexcept nogil:
    """Return i!."""
    cdef double product = 1.0
    cdef int k
    for k in range(2, i + 1):
        product *= k
    return product


cdef double power(double x, int count) noexcept nogil:
    """Return x^count by products, which scale exactly with x where it is doubled."""
    cdef double product = 1.0
    for _ in range(count):
        product *= x
    return product


cdef void by_binomials(double* chain, int count, double more) noexcept nogil:
    """Turn (D + c)^j d, j = 0, 1, .., into (D + c + more)^j d, in place."""
    cdef int first, j
    for first in range(1, count):
        for j in range(count - 1, first - 1, -1):
            chain[j] += more * chain[j - 1]


cdef void put(Members* m, int g, const double* estimate) noexcept nogil:
    """Put a member to an estimate of z, d, d', ..; its own states are (D + kappa)^j d."""
    cdef double chain[ORDERS]
    cdef int i
    for i in range(m.n):
        m.x.z[i][g] = estimate[i]
    for i in range(ORDERS):
        chain[i] = estimate[m.n + i]
    by_binomials(chain, ORDERS, m.kappa[g])
    for i in range(ORDERS):
        m.x.d[i][g] = chain[i] if i <= GRID.order[g] else 0.0


cdef void find_tuning(Members* m, double* found) noexcept nogil:
    """Write noise, correlation, bandwidth and shares of models: the fields of `Tuning`."""
    cdef double variance = 0.0, correlation = 0.0, bands = 0.0, w, a
    cdef int g, c
    for g in range(ORDERS):
        found[3 + g] = 0.0
    for g in range(COUNT):
        w, a, c = m.weight[g], m.correlation[g], GRID.colour[g]
        variance += w * (m.noise[c] + m.late[c] * m.shared.of_stamps) / (1.0 - a * a)
        correlation += w * a
        bands += w * GRID.band[g]
        found[3 + GRID.order[g]] += w
    found[0], found[1] = sqrt(variance), correlation
    found[2] = m.kappa[HALF] / DECAY * exp(bands * log(BAND_STEP))
