# SPDX-License-Identifier: Apache-2.0
"""The members begin; how likely each of them is, and the mean of all (D 28, D 34)."""

from libc.math cimport INFINITY, M_PI, NAN, cos, exp, fabs, fmin, isfinite, log, pow, sqrt
from libc.string cimport memmove

from fhaosmo_ros.core.observer.self_tuning.jumps cimport watch
from fhaosmo_ros.core.observer.self_tuning.members cimport (
    BAND_STEP, COLOURS, COUNT, DECAY, FIRST_SAMPLES, GRID, HALF, HUBER, ORDERS, Members,
    Shared, Work, entry, factorial, fill, largest, leeway, power
)
from fhaosmo_ros.core.observer.self_tuning.noise cimport (
    FADED, ROUNDED, find_noise, follow_differences
)
from fhaosmo_ros.core.observer.structure cimport GATE
from fhaosmo_ros.core.vectors cimport VECTORISED

# No log-likelihood falls further below the best one (D 28, D 31), but by what the member's prior
# is below that of the likeliest: a larger d needs more reason to be believed.
# One that is FLOOR below has no weight.
cdef double FLOOR = 30.0
cdef double KEPT = exp(-1.0 / 8000.0)  # part of a log-likelihood that is not forgotten
# States may be so many times as large: a start that is too sure of them costs more than one that
# is not sure enough.
cdef double DOUBT = 10.0
# Samples for which the members wait at most where the first ones come in bursts: ten of 32 each
# tell the policy how to place them (core/online/clock.pyx), after which they begin afresh.
cdef double LONGEST_WAIT = 320.0


# The first samples

cdef void gather(Members* m) noexcept nogil:
    """
    Collect the first samples; once there are enough, let the members begin (D 28).

    y may be constant until its sensor is ready: then the last constant one is the first of them.
    Where they come in bursts, the members wait for later ones.
    """
    cdef Shared* shared = &m.shared
    cdef double y = m.work.sample.y
    cdef int count = min(max(shared.samples, 1), FIRST_SAMPLES - 1)
    if count == 1:
        m.first_y[0], m.first_h[0] = m.work.sample.before, 0.0
    if count > 1 or fabs(y - m.first_y[0]) > ROUNDED * fabs(y):
        m.first_y[count], m.first_h[count] = y, m.work.sample.h
        count += 1
    shared.samples = count
    if count == FIRST_SAMPLES and begins_in_bursts(m) and shared.waiting < LONGEST_WAIT:
        shared.samples = count = FIRST_SAMPLES // 2  # the first half makes room
        shared.waiting += count
        memmove(m.first_y, m.first_y + count, count * sizeof(double))
        memmove(m.first_h, m.first_h + count, count * sizeof(double))
    if count == FIRST_SAMPLES:
        shared.waiting = 0.0
        begin(m, find_noise(m))
        shared.samples = FIRST_SAMPLES + 1


cdef bint begins_in_bursts(Members* m) noexcept nogil:
    """Return True if more than a quarter of the first intervals are below half of the mean."""
    cdef double total = 0.0
    cdef int i, close = 0
    for i in range(1, FIRST_SAMPLES):
        total += m.first_h[i]
    for i in range(1, FIRST_SAMPLES):
        close += m.first_h[i] * (FIRST_SAMPLES - 1) < 0.5 * total
    return 4 * close > FIRST_SAMPLES


cdef void find_sizes(Members* m) noexcept nogil:
    """Find mean squares of z, with doubt, by differences of the first samples."""
    cdef double first[FIRST_SAMPLES]
    cdef double total
    cdef int stride = (FIRST_SAMPLES - 1) // m.n, length, i, j
    m.sizes[0] = 0.0
    for j in range(FIRST_SAMPLES):
        first[j] = m.first_y[j]
    for i in range(1, m.n):
        length, total = FIRST_SAMPLES - i * stride, 0.0
        for j in range(length):
            first[j] = (first[j + stride] - first[j]) / (stride * m.shared.steady_period)
            total += first[j] * first[j]
        m.sizes[i] = DOUBT * DOUBT * total / length


cdef void begin(Members* m, double noise) noexcept nogil:
    """Let the members begin at the last sample (D 28); z behind z_1 follows in `begin_at_rest`."""
    cdef Shared* shared = &m.shared
    cdef double y = m.first_y[FIRST_SAMPLES - 1], period = shared.steady_period
    cdef double omega, kappa, intensity, size, least = INFINITY, sizes = 0.0
    cdef int n = m.n, g, i, j, k, below, c
    find_sizes(m)
    shared.active = COUNT
    shared.first_noise, shared.first_period = noise * noise, period
    for c in range(COLOURS):
        m.used_noise[c] = noise * noise
    for g in range(COUNT):
        c, omega = GRID.colour[g], GRID.bandwidth[g] / period
        m.kappa[g], m.correlation[g] = DECAY * omega, GRID.correlation[c]
    for j in range(n + 2):
        m.latest_y[j], m.ages[j] = m.first_y[0], j * period
    shared.roughness = 1.0
    for j in range(1, FIRST_SAMPLES):
        follow_differences(m, m.first_y[j], m.first_h[j])
    for g in range(COUNT):
        omega, kappa, k = GRID.bandwidth[g] / period, m.kappa[g], GRID.order[g]
        intensity = noise * noise * period * power(omega, 2 * (n + 1 + k))
        m.drive[k][g] = intensity
        m.x.z[0][g], m.p.zz[0][g] = y, noise * noise
        for i in range(k + 1):
            for j in range(i, k + 1):
                below = 2 * k - i - j
                m.p.dd[i][j][g] = intensity * factorial(below) / (
                    factorial(k - i) * factorial(k - j) * power(2.0 * kappa, below + 1)
                )
        size = log(m.p.dd[0][0][g] / m.p.dd[0][0][0])
        m.prior[g] = -0.5 * size
        least = fmin(least, size)
        sizes += size
    # Before samples have told: the geometric mean of what the members expect.
    shared.size_of_d = m.p.dd[0][0][0] * exp(sizes / COUNT)
    for g in range(COUNT):
        m.prior[g] += 0.5 * least
        m.score[g] = m.prior[g]
        m.variance[g] = m.short_mean[g] = 1.0
        m.log_variance[g] = m.residual[g] = m.far[g] = 0.0
    weigh(m)
    shared.told = shared.likeliest
    watch(m, shared.told)


# A sample

cdef VECTORISED judge(Members* m, bint counts) noexcept nogil:
    """
    Take a sample into the log-likelihoods, and bound the innovations (D 27, D 28), in place.

    If it does not count, the log-likelihoods stay.
    """
    cdef Work* w = &m.work
    cdef Py_ssize_t g, active = m.shared.active
    cdef double grown = m.shared.grown, kept = KEPT, likelihood, most, limit
    cdef double logs[COLOURS]
    for g in range(active):
        w.ratio[g] = w.b[g] * w.b[g] / (w.s[g] * w.noise[g])
        m.far[g] = m.far[g] + 1.0 if w.ratio[g] > GATE * GATE else 0.0
    if counts:
        for g in range(COLOURS):
            logs[g] = log(w.now[g] / m.shared.first_noise)
        fill(w.one, logs)
        for g in range(active):
            most = HUBER * HUBER * leeway(m.far[g])
            likelihood = w.ratio[g] / grown
            likelihood = likelihood if likelihood < most else most
            likelihood += m.log_variance[g] + w.one[g]
            m.score[g] = m.prior[g] + kept * (m.score[g] - m.prior[g]) - 0.5 * likelihood
    for g in range(active):
        if w.ratio[g] > HUBER * HUBER:
            limit = HUBER * sqrt(w.s[g] * w.noise[g]) * leeway(m.far[g])
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
    cdef int g, k, levels
    cdef double noise, a, edge
    if 2.0 * m.score[shared.told] < -FADED:
        shared.told = shared.likeliest
    g = shared.told
    k, noise, a = GRID.order[g], m.work.now[GRID.colour[g]], m.correlation[g]
    model.drive, model.loss, levels = m.drive[k][g], m.kappa[g], m.n + 1 + k
    edge = pow(model.drive / noise * power(m.work.sample.h, 2 * levels - 1), 0.5 / levels)
    model.noise = noise / (1.0 + a * (a - 2.0 * cos(fmin(edge, M_PI))))
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
