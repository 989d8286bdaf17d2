# SPDX-License-Identifier: Apache-2.0
"""How likely each member is, and the mean of all (D 28)."""

from libc.math cimport M_PI, NAN, cos, exp, fmin, isfinite, log, pow, sqrt

from fhaosmo_ros.core.observer.self_tuning.filters cimport HUBER
from fhaosmo_ros.core.observer.self_tuning.members cimport (
    COLOURS, FIRST_SAMPLES, GRID, Members, ORDERS, Shared, Work, entry, fill, largest, power
)
from fhaosmo_ros.core.observer.self_tuning.noise cimport FADED
from fhaosmo_ros.core.vectors cimport VECTORISED
from fhaosmo_ros.core.observer.structure cimport GATE

# No log-likelihood falls further below the best one (D 28, D 31), but by what the member's prior
# is below that of the likeliest: a larger d needs more reason to be believed.
# One that is FLOOR below has no weight.
cdef double FLOOR = 30.0


cdef VECTORISED judge(Members* m, double grown, double kept) noexcept nogil:
    """
    Take a sample into the log-likelihoods, and bound the innovations (D 27, D 28), in place.

    `kept` is the part of the log-likelihoods that is not forgotten; negative to leave them as they
    are. Samples in a row that are far off a member are not outliers, but its fault.
    """
    cdef Work* w = &m.work
    cdef Py_ssize_t g, active = m.shared.active
    cdef double late, likelihood, most, limit
    cdef double logs[COLOURS]
    for g in range(active):
        w.ratio[g] = w.b[g] * w.b[g] / (w.s[g] * w.noise[g])
        m.far[g] = m.far[g] + 1.0 if w.ratio[g] > GATE * GATE else 0.0
    if kept >= 0.0:
        for g in range(COLOURS):
            logs[g] = log(w.now[g] / m.shared.first_noise)
        fill(w.one, logs)
        for g in range(active):
            late = m.far[g] - 1.0 if m.far[g] > 1.0 else 0.0
            most = HUBER * HUBER * (1.0 + late * late)
            likelihood = w.ratio[g] / grown
            likelihood = likelihood if likelihood < most else most
            likelihood += m.log_variance[g] + w.one[g]
            m.score[g] = m.prior[g] + kept * (m.score[g] - m.prior[g]) - 0.5 * likelihood
    for g in range(active):
        if w.ratio[g] > HUBER * HUBER:
            late = m.far[g] - 1.0 if m.far[g] > 1.0 else 0.0  # in a row: not an outlier, but d
            limit = HUBER * sqrt(w.s[g] * w.noise[g]) * (1.0 + late * late)
            w.b[g] = limit if w.b[g] > limit else -limit if w.b[g] < -limit else w.b[g]


cdef VECTORISED weigh(Members* m) noexcept nogil:
    """Turn log-likelihoods into weights (D 28), and say which member is the likeliest."""
    cdef Py_ssize_t g, active = m.shared.active, likeliest = 0
    cdef double best = largest(m.score, active), total = 0.0, usual, score, least
    while likeliest < active - 1 and m.score[likeliest] < best:  # the first: at first many are
        likeliest += 1
    m.shared.likeliest, usual = <int>likeliest, m.prior[likeliest]
    for g in range(active):
        score, least = m.score[g] - best, m.prior[g] - usual
        least = (least if least < 0.0 else 0.0) - FLOOR
        m.score[g] = score if score > least else least
        m.weight[g] = 0.0
    for g in range(active):
        if m.score[g] > -FLOOR:  # few of them
            m.weight[g] = exp(m.score[g])
            total += m.weight[g]
    for g in range(active):
        m.weight[g] *= 1.0 / total


cdef void tell_model(Members* m, bint jumped, Model* model) noexcept nogil:
    """
    Write the model of d and the noise of the likeliest member, for a smoother (D 34).

    It stays until another one is clearly likelier. Coloured noise counts as white noise that is as
    dense where the member's bandwidth ends.
    """
    cdef Shared* shared = &m.shared
    cdef int g, k
    cdef double noise, a, twice, edge, h = m.work.sample.h
    if 2.0 * m.score[shared.told] < -FADED:
        shared.told = shared.likeliest
    g = shared.told
    k, noise, a = GRID.order[g], m.work.now[GRID.colour[g]], m.correlation[g]
    twice = 2.0 * (m.n + 1 + k)
    model.drive, model.loss = m.drive[k][g], m.kappa[g]
    edge = fmin(pow(model.drive / noise * power(h, 2 * (m.n + 1 + k) - 1), 1.0 / twice), M_PI)
    model.noise = noise / (1.0 + a * (a - 2.0 * cos(edge)))
    model.derivatives = k - ORDERS if jumped else k


cdef VECTORISED mix(Members* m, double* mean, double* variances) noexcept nogil:
    """
    Write the mean of the members' estimates of z, d, d', .., and its variances (D 28).

    Members do not know how large d usually is: where their estimates of it are vague, they are
    drawn to 0, as for a d whose standard deviation is `HUBER` times its size of late. That is of
    the estimates and of what they miss, which counts as far as it is smaller than the size so far.
    The first one is NaN if a member, or its weight, is lost: where Phi or P grows without a limit.
    """
    cdef Work* w = &m.work
    cdef int n = m.n, i
    cdef Py_ssize_t g, active = m.shared.active
    cdef double* z
    cdef double* p
    cdef double c, total, off, lost = 0.0
    for g in range(active):
        c = m.kappa[g]
        w.d[0][g] = m.x.d[0][g]
        w.d[1][g] = m.x.d[1][g] - c * m.x.d[0][g]
        w.d[2][g] = m.x.d[2][g] - c * (2.0 * m.x.d[1][g] - c * m.x.d[0][g])
        w.d[3][g] = m.x.d[3][g] - c * (
            3.0 * m.x.d[2][g] - c * (3.0 * m.x.d[1][g] - c * m.x.d[0][g])
        )
        lost += m.x.z[0][g] * m.weight[g] + m.p.zz[0][g]
    for i in range(n + ORDERS):
        z = &m.x.z[i][0] if i < n else &w.d[i - n][0]
        p, total = entry(&m.p, n, i, i), 0.0
        for g in range(active):  # a member without weight may be anywhere
            total += m.weight[g] * z[g] if m.weight[g] > 0.0 else 0.0
        mean[i], total = total, 0.0
        if i <= n:
            for g in range(active):
                off = z[g] - mean[i]
                off = (p[g] if p[g] > 0.0 else 0.0) + off * off
                total += m.weight[g] * off if m.weight[g] > 0.0 else 0.0
        variances[i] = total
    total = m.shared.size_of_d + (
        mean[n] * mean[n] + fmin(variances[n], m.shared.size_of_d) - m.shared.size_of_d
    ) / (w.sample.average - FIRST_SAMPLES)
    m.shared.size_of_d = total
    if total > 0.0:
        c, total = HUBER * HUBER * total, 0.0
        z, p = &w.d[0][0], &m.p.dd[0][0][0]
        for g in range(active):
            off = m.weight[g] * z[g] * (c / (c + (p[g] if p[g] > 0.0 else 0.0)))
            total += off if m.weight[g] > 0.0 else 0.0
        mean[n] = total
    if not isfinite(lost):
        mean[0] = NAN
