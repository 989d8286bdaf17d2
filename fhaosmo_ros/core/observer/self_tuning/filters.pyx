# SPDX-License-Identifier: Apache-2.0
"""
The members as filters: prediction and correction, and jumps of d (D 27, D 33).

Only the covariances of members `Work.first` .. `Work.last` - 1 move; the others rest at their
steady values.
"""

from libc.math cimport log, sqrt
from libc.string cimport memset

from fhaosmo_ros.core.observer.self_tuning.members cimport (
    COLOURS, COUNT, GRID, Line, Members, MOST_STATES, ORDERS, Work, entry, factorial, fill, pair,
    power, state
)
from fhaosmo_ros.core.vectors cimport VECTORISED

cdef double HUBER = 3.0  # innovations of more standard deviations count as so many (Huber 1964)
# y and its stamps are taken to be no more exact than this: in parts of what y moves between
# samples (RMS), and of the period.
cdef double EXACT = 1e-5
# By this factor S is too large, and so are variances that are raised after a jump, so that P stays
# positive where y is by many orders of magnitude more exact than its prediction: what is left of P
# then is more than what rounding makes of it.
cdef double INEXACT = 1.0 + EXACT * EXACT


cdef VECTORISED predict_states(
    Members* m, double h, const double* mean, const double* predicted
) noexcept nogil:
    """Predict the members' estimates: the mean's path, plus the flow of their deviations."""
    cdef Work* w = &m.work
    cdef int n = m.n, i, j
    cdef Py_ssize_t g, active = m.shared.active
    cdef double a = h, b = h * h / 2.0, c = h * h * h / 6.0, base, f, f1, f2, f3, kappa
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
            m.x.d[0][g] + a * m.x.d[1][g] + b * m.x.d[2][g] + c * m.x.d[3][g]
        )
        w.x.d[1][g] = m.decayed[g] * (m.x.d[1][g] + a * m.x.d[2][g] + b * m.x.d[3][g])
        w.x.d[2][g] = m.decayed[g] * (m.x.d[2][g] + a * m.x.d[3][g])
        w.x.d[3][g] = m.decayed[g] * m.x.d[3][g]


cdef inline double share(const double* powers, double h, int a, int b) noexcept nogil:
    """Return the integral of t^(a + b) / (a! b!) over h: what q adds to a covariance (D 20)."""
    return powers[a] * powers[b] * h / (a + b + 1) if a >= 0 and b >= 0 else 0.0


cdef VECTORISED integrate_drive(Members* m, double h) noexcept nogil:
    """Write Q (D 27), unless it is there already."""
    cdef Work* w = &m.work
    cdef int n = m.n, d = n + ORDERS, i, j, k
    cdef Py_ssize_t g
    cdef double powers[MOST_STATES]
    cdef double* row
    cdef double q
    # All other intensities follow from these two (D 26).
    if (w.q_interval == h and w.q_white == m.drive[0][0] and w.q_jerk == m.drive[3][COUNT - 1]
            and w.q_first <= w.first and w.last <= w.q_last):
        return
    w.q_interval, w.q_white, w.q_jerk = h, m.drive[0][0], m.drive[3][COUNT - 1]
    w.q_first, w.q_last = w.first, w.last
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


cdef VECTORISED predict_drive(Members* m, double h) noexcept nogil:
    """Predict the covariances of d and its derivatives; written out, for speed (D 17)."""
    cdef Work* w = &m.work
    cdef Py_ssize_t g
    cdef double a = h, b = h * h / 2.0, c = h * h * h / 6.0
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


cdef VECTORISED predict_covariances(Members* m, double h) noexcept nogil:
    """Write A P A' + Q (D 27)."""
    cdef Work* w = &m.work
    cdef int n = m.n, i, j, k
    cdef Py_ssize_t g, first = w.first, last = w.last
    cdef double a = h, b = h * h / 2.0, c = h * h * h / 6.0, slope, second, third, f
    integrate_drive(m, h)
    predict_drive(m, h)
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


cdef VECTORISED expect(Members* m, double h, double y) noexcept nogil:
    """Write what the members expect of a sample, P C' and S, and by what it is off (D 27)."""
    cdef Work* w = &m.work
    cdef int n = m.n, i
    cdef Py_ssize_t g
    cdef double half = 0.5 * h * h, more
    cdef double* row
    cdef double* one
    cdef double* two
    cdef double* three
    for g in range(m.shared.active):
        w.b[g] = y - w.x.z[0][g] - m.correlation[g] * m.residual[g]
        w.s[g] = m.variance[g]
    if w.first == w.last:
        return
    predict_covariances(m, h)
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


cdef VECTORISED allow_jump(Members* m, double y, double tau) noexcept nogil:
    """
    Let the members believe that d has jumped: raise P as far as the sample asks for it (D 33).

    It was `tau` ago; 0 for the samples that follow, for which P knows what is uncertain. What the
    noise was before does not count, so that coloured noise begins afresh. Innovations, their
    variances, and the predicted P and P C' are replaced.
    """
    cdef Work* w = &m.work
    cdef int n = m.n, i, j
    cdef Py_ssize_t g, active = m.shared.active
    cdef double part, variance, square
    cdef double* row
    cdef double* one
    fill(w.one, m.used_noise)
    for g in range(active):
        w.b[g] = y - w.x.z[0][g]
        square = w.b[g] * w.b[g]
        variance = w.p.zz[0][g] + w.one[g] / (1.0 - m.correlation[g] * m.correlation[g])
        w.two[g] = square - variance if square > HUBER * HUBER * variance else 0.0
        w.s[g] = INEXACT * (variance + w.two[g]) / w.one[g]
        if tau == 0.0:
            w.two[g] = 1.0 + (w.two[g] / w.p.zz[0][g] if w.p.zz[0][g] > 0.0 else 0.0)
    for i in range(n + ORDERS):
        for j in range(i, n + ORDERS):
            row = entry(&w.p, n, i, j)
            if tau == 0.0:
                part = INEXACT if i == j else 1.0
                for g in range(active):
                    row[g] *= part * w.two[g]
            elif j <= n:  # at its begin, or at any time of it
                part = factorial(n) / factorial(n - i) * factorial(n) / factorial(n - j)
                part *= 0.5 + 0.5 * (2.0 * n + 1.0) / (2.0 * n + 1.0 - i - j)
                part /= power(tau, i + j)
                for g in range(active):
                    row[g] += part * w.two[g]
    for i in range(n + ORDERS):
        row, one = state(&w.pc, n, i), entry(&w.p, n, 0, i)
        for g in range(active):
            row[g] = one[g]


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


cdef VECTORISED correct_states(Members* m, double y) noexcept nogil:
    """Correct the members' predictions by their innovations, of bounded influence."""
    cdef Work* w = &m.work
    cdef int i
    cdef Py_ssize_t g, active = m.shared.active
    cdef double limits[COLOURS]
    cdef double a, residual
    for i in range(COLOURS):
        a = m.correlation[GRID.first[i]]
        limits[i] = HUBER * sqrt(m.work.now[i] / (1.0 - a * a))
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
