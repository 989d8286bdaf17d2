# SPDX-License-Identifier: Apache-2.0
"""
The members of the self-tuning observer: which they are (D 26), and their filters (D 27).

A member is an observer with its own model of d (D 17: k = 0, 1 or 3 derivatives, intensity q,
decay kappa) and of the noise (white, or coloured: v_j = a v_{j-1} + w_j). All have n + 4 states,
of which those of derivatives that a model does not have stay 0. Each quantity is a line of one
number a member, so that a step of all members is a few long loops that the compiler turns into
vector instructions. Members with white noise come first, from the quickest to the slowest; those
with coloured noise follow from the slowest to the quickest: where only slow members' covariances
move, those of `Work.first` .. `Work.last` - 1, they are neighbours. The others rest at their
steady values.
"""

from libc.math cimport log, sqrt
from libc.string cimport memset

from fhaosmo_ros.core.vectors cimport VECTORISED

import numpy as np

SLOWEST, QUICKEST = 6e-4, 3.0  # range of the bandwidths (rad a sample)
DERIVATIVES = [0, 1, ORDERS - 1]  # k of the members of each bandwidth
cdef double DECAY = 0.1
cdef double BAND_STEP  # omega of a band over that of the next slower one
CORRELATIONS = [0.0, 0.75, 0.92, 0.98]  # a of the colours of the noise
COLOURED = [1, 3, 1, 2]  # of the members of four bandwidths in turn
cdef double HUBER = 3.0  # innovations of more standard deviations count as so many (Huber 1964)
# y and its stamps are taken to be no more exact than this: in parts of what y moves between
# samples (RMS), and of the period.
cdef double EXACT = 1e-5
# By this factor S is too large, and so are variances that are raised after a jump, so that P stays
# positive where y is by many orders of magnitude more exact than its prediction: what is left of P
# then is more than what rounding makes of it.
cdef double INEXACT = 1.0 + EXACT * EXACT
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


cdef void go_on_from(Members* m, int g, int other) noexcept nogil:
    """Let a member go on from where another one is, and as sure of it."""
    cdef int i, j, n = m.n, most = n + GRID.order[g]
    for i in range(n + ORDERS):
        state(&m.x, n, i)[g] = state(&m.x, n, i)[other] if i <= most else 0.0
        state(&m.gain, n, i)[g] = state(&m.gain, n, i)[other] if i <= most else 0.0
        for j in range(i, n + ORDERS):
            entry(&m.p, n, i, j)[g] = entry(&m.p, n, i, j)[other] if j <= most else 0.0
    m.variance[g], m.log_variance[g] = m.variance[other], m.log_variance[other]
    m.residual[g], m.short_mean[g], m.far[g] = 0.0, 1.0, 0.0


# Prediction

cdef VECTORISED predict_states(
    Members* m, const double* mean, const double* predicted
) noexcept nogil:
    """Predict the members' estimates: the mean's path, plus the flow of their deviations."""
    cdef Work* w = &m.work
    cdef int n = m.n, i, j
    cdef Py_ssize_t g, active = m.shared.active
    cdef double h = w.sample.h, b = h * h / 2.0, c = h * h * h / 6.0, base, f, f1, f2, f3, kappa
    for i in range(n):
        base = predicted[i]
        for j in range(n + ORDERS):
            base -= m.flow[i][j] * mean[j]
        f, f1, f2, f3 = m.flow[i][n], m.flow[i][n + 1], m.flow[i][n + 2], m.flow[i][n + 3]
        for g in range(active):
            kappa = m.kappa[g]
            w.chain[i][0][g] = f - kappa * (f1 - kappa * (f2 - kappa * f3))
            w.chain[i][1][g] = f1 - kappa * (2.0 * f2 - 3.0 * kappa * f3)
            w.chain[i][2][g] = f2 - 3.0 * kappa * f3
            w.chain[i][3][g] = f3
            w.x.z[i][g] = (
                base + w.chain[i][0][g] * m.x.d[0][g] + w.chain[i][1][g] * m.x.d[1][g]
                + w.chain[i][2][g] * m.x.d[2][g] + f3 * m.x.d[3][g]
            )
        for j in range(n):
            f = m.flow[i][j]
            if f != 0.0:
                for g in range(active):
                    w.x.z[i][g] += f * m.x.z[j][g]
    for g in range(active):  # exp of D 17: e^(-kappa h) times a polynomial
        w.x.d[0][g] = m.decayed[g] * (
            m.x.d[0][g] + h * m.x.d[1][g] + b * m.x.d[2][g] + c * m.x.d[3][g]
        )
        w.x.d[1][g] = m.decayed[g] * (m.x.d[1][g] + h * m.x.d[2][g] + b * m.x.d[3][g])
        w.x.d[2][g] = m.decayed[g] * (m.x.d[2][g] + h * m.x.d[3][g])
        w.x.d[3][g] = m.decayed[g] * m.x.d[3][g]


cdef inline double share(const double* powers, double h, int a, int b) noexcept nogil:
    """Return the integral of t^(a + b) / (a! b!) over h: what q adds to a covariance (D 20)."""
    return powers[a] * powers[b] * h / (a + b + 1) if a >= 0 and b >= 0 else 0.0


cdef VECTORISED integrate_drive(Members* m) noexcept nogil:
    """Write Q (D 27), unless it is there already."""
    cdef Work* w = &m.work
    cdef int n = m.n, d = n + ORDERS, i, j, k
    cdef Py_ssize_t g
    cdef double powers[MOST_STATES]
    cdef double* row
    cdef double h = w.sample.h, q
    if w.q_interval == h and w.q_first <= w.first and w.last <= w.q_last:
        return
    w.q_interval, w.q_first, w.q_last = h, w.first, w.last
    powers[0] = 1.0  # h^j / j!
    for i in range(1, d):
        powers[i] = powers[i - 1] * h / i
    for i in range(d):
        for j in range(i, d):
            row = entry(&w.q, n, i, j)
            memset(row, 0, sizeof(Line))
            for k in range(ORDERS):
                q = share(powers, h, n + k - i, n + k - j)
                for g in range(w.first, w.last):
                    row[g] += q * m.drive[k][g]


cdef VECTORISED predict_drive(Members* m) noexcept nogil:
    """Predict the covariances of d and its derivatives; written out, for speed (D 17)."""
    cdef Work* w = &m.work
    cdef Py_ssize_t g
    cdef double a = w.sample.h, b = a * a / 2.0, c = a * a * a / 6.0
    cdef double p11, p12, p13, p22, p23, p33, none, slope, second, third, one, two, three, twice
    for g in range(w.first, w.last):
        p11, p12, p13 = m.p.dd[1][1][g], m.p.dd[1][2][g], m.p.dd[1][3][g]
        p22, p23, p33 = m.p.dd[2][2][g], m.p.dd[2][3][g], m.p.dd[3][3][g]
        twice = m.decayed[g] * m.decayed[g]
        one, two = p11 + a * p12 + b * p13, p12 + a * p22 + b * p23
        three, third = p13 + a * p23 + b * p33, m.p.dd[0][3][g] + a * p13 + b * p23 + c * p33
        second = m.p.dd[0][2][g] + a * p12 + b * p22 + c * p23
        slope = m.p.dd[0][1][g] + a * p11 + b * p12 + c * p13
        none = (
            m.p.dd[0][0][g] + a * m.p.dd[0][1][g] + b * m.p.dd[0][2][g] + c * m.p.dd[0][3][g]
        )
        w.p.dd[0][0][g] = w.q.dd[0][0][g] + twice * (none + a * slope + b * second + c * third)
        w.p.dd[0][1][g] = w.q.dd[0][1][g] + twice * (slope + a * second + b * third)
        w.p.dd[0][2][g] = w.q.dd[0][2][g] + twice * (second + a * third)
        w.p.dd[0][3][g] = w.q.dd[0][3][g] + twice * third
        w.p.dd[1][1][g] = w.q.dd[1][1][g] + twice * (one + a * two + b * three)
        w.p.dd[1][2][g] = w.q.dd[1][2][g] + twice * (two + a * three)
        w.p.dd[1][3][g] = w.q.dd[1][3][g] + twice * three
        w.p.dd[2][2][g] = w.q.dd[2][2][g] + twice * (p22 + a * p23 + a * (p23 + a * p33))
        w.p.dd[2][3][g] = w.q.dd[2][3][g] + twice * (p23 + a * p33)
        w.p.dd[3][3][g] = w.q.dd[3][3][g] + twice * p33


cdef VECTORISED multiply(Members* m, int i) noexcept nogil:
    """Write row i of A P, of a state z_i."""
    cdef Work* w = &m.work
    cdef int n = m.n, j, k
    cdef Py_ssize_t g, first = w.first, last = w.last
    cdef double f
    for k in range(ORDERS):
        for g in range(first, last):
            w.product_d[i][k][g] = (
                w.chain[i][0][g] * m.p.dd[0][k][g]
                + w.chain[i][1][g] * m.p.dd[min(1, k)][max(1, k)][g]
                + w.chain[i][2][g] * m.p.dd[min(2, k)][max(2, k)][g]
                + w.chain[i][3][g] * m.p.dd[k][3][g]
            )
    for j in range(n):
        f = m.flow[i][j]
        if f != 0.0:
            for g in range(first, last):
                w.product_d[i][0][g] += f * m.p.zd[j][0][g]
                w.product_d[i][1][g] += f * m.p.zd[j][1][g]
                w.product_d[i][2][g] += f * m.p.zd[j][2][g]
                w.product_d[i][3][g] += f * m.p.zd[j][3][g]
        for g in range(first, last):
            w.product_z[i][j][g] = (
                w.chain[i][0][g] * m.p.zd[j][0][g] + w.chain[i][1][g] * m.p.zd[j][1][g]
                + w.chain[i][2][g] * m.p.zd[j][2][g] + w.chain[i][3][g] * m.p.zd[j][3][g]
            )
        for k in range(n):
            f = m.flow[i][k]
            if f != 0.0:
                for g in range(first, last):
                    w.product_z[i][j][g] += f * m.p.zz[pair(k, j)][g]


cdef VECTORISED predict_covariances(Members* m) noexcept nogil:
    """Write A P A' + Q (D 27)."""
    cdef Work* w = &m.work
    cdef int n = m.n, i, j, k
    cdef Py_ssize_t g, first = w.first, last = w.last
    cdef double a = w.sample.h, b = a * a / 2.0, c = a * a * a / 6.0, slope, second, third, f
    integrate_drive(m)
    predict_drive(m)
    for i in range(n):
        multiply(m, i)
        for g in range(first, last):
            slope, second, third = (
                w.product_d[i][1][g], w.product_d[i][2][g], w.product_d[i][3][g]
            )
            w.p.zd[i][0][g] = w.q.zd[i][0][g] + m.decayed[g] * (
                w.product_d[i][0][g] + a * slope + b * second + c * third
            )
            w.p.zd[i][1][g] = w.q.zd[i][1][g] + m.decayed[g] * (slope + a * second + b * third)
            w.p.zd[i][2][g] = w.q.zd[i][2][g] + m.decayed[g] * (second + a * third)
            w.p.zd[i][3][g] = w.q.zd[i][3][g] + m.decayed[g] * third
        for j in range(i, n):
            for g in range(first, last):
                w.p.zz[pair(i, j)][g] = (
                    w.q.zz[pair(i, j)][g]
                    + w.chain[j][0][g] * w.product_d[i][0][g]
                    + w.chain[j][1][g] * w.product_d[i][1][g]
                    + w.chain[j][2][g] * w.product_d[i][2][g]
                    + w.chain[j][3][g] * w.product_d[i][3][g]
                )
            for k in range(n):
                f = m.flow[j][k]
                if f != 0.0:
                    for g in range(first, last):
                        w.p.zz[pair(i, j)][g] += f * w.product_z[i][k][g]


cdef VECTORISED expect(Members* m) noexcept nogil:
    """Write what the members expect of a sample, P C' and S, and by what it is off (D 27)."""
    cdef Work* w = &m.work
    cdef int n = m.n, i
    cdef Py_ssize_t g
    cdef double y = w.sample.y, h = w.sample.h, half = 0.5 * h * h, more
    cdef double* row
    cdef double* one
    cdef double* two
    cdef double* three
    for g in range(m.shared.active):
        w.b[g] = y - w.x.z[0][g] - m.correlation[g] * m.residual[g]
        w.s[g] = m.variance[g]
    if w.first == w.last:
        return
    predict_covariances(m)
    for i in range(n + ORDERS):  # z_1 of the sample before is the state of now, h back
        row, one, two = state(&w.pc, n, i), entry(&w.p, n, 0, i), entry(&w.p, n, 1, i)
        three = entry(&w.p, n, 2, i)
        for g in range(w.first, w.last):
            row[g] = one[g] - m.correlation[g] * (one[g] - h * two[g] + half * three[g])
    fill(w.one, m.used_noise)
    one, two, three = state(&w.pc, n, 0), state(&w.pc, n, 1), state(&w.pc, n, 2)
    for g in range(w.first, w.last):
        more = one[g] - m.correlation[g] * (one[g] - h * two[g] + half * three[g])
        w.s[g] = INEXACT * (1.0 + (more if more > 0.0 else 0.0) / w.one[g])


# Correction

cdef VECTORISED correct(Members* m, bint by_interval) noexcept nogil:
    """
    Take a sample into the covariances that move, and turn P C' into gains (D 27).

    With the factors that `take_interval` has found, or those of a Kalman filter.
    """
    cdef Work* w = &m.work
    cdef int n = m.n, i, j
    cdef Py_ssize_t g, first = w.first, last = w.last
    cdef double* before
    cdef double* after
    cdef double* one
    cdef double* two
    for g in range(first, last):
        m.variance[g] = w.s[g]
    if not by_interval and first < last:
        fill(w.one, m.used_noise)
        for g in range(first, last):  # where rounding has made z_1 certain, nothing is taken
            w.inverse[g] = w.taken[g] = (1.0 if w.s[g] > INEXACT else 0.0) / (w.s[g] * w.one[g])
        for g in range(first, last):
            m.log_variance[g] = log(w.s[g])
    for i in range(n + ORDERS):
        after, one = state(&m.gain, n, i), state(&w.pc, n, i)
        for g in range(first, last):
            after[g] = one[g] * w.inverse[g]
        for j in range(i, n + ORDERS):
            before, after = entry(&w.p, n, i, j), entry(&m.p, n, i, j)
            two = state(&w.pc, n, j)
            for g in range(first, last):
                after[g] = before[g] - w.taken[g] * one[g] * two[g]


cdef VECTORISED correct_states(Members* m) noexcept nogil:
    """Correct the members' predictions by their innovations, of bounded influence."""
    cdef Work* w = &m.work
    cdef int i
    cdef Py_ssize_t g, active = m.shared.active
    cdef double limits[COLOURS]
    cdef double y = w.sample.y, a, residual
    for i in range(COLOURS):
        a = m.correlation[GRID.first[i]]
        limits[i] = HUBER * sqrt(w.now[i] / (1.0 - a * a))
    fill(w.one, limits)
    for i in range(m.n):
        for g in range(active):
            m.x.z[i][g] = w.x.z[i][g] + m.gain.z[i][g] * w.b[g]
    for i in range(ORDERS):
        for g in range(active):
            m.x.d[i][g] = w.x.d[i][g] + m.gain.d[i][g] * w.b[g]
    for g in range(active):
        residual = y - m.x.z[0][g]
        residual = residual if residual > -w.one[g] else -w.one[g]
        m.residual[g] = residual if residual < w.one[g] else w.one[g]
