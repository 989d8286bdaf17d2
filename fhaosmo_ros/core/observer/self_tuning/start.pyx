# SPDX-License-Identifier: Apache-2.0
"""The first samples, and members that begin with what these tell (D 26, D 28)."""

from libc.math cimport INFINITY, exp, fabs, fmax, fmin, log, sqrt
from libc.string cimport memset

from fhaosmo_ros.core.observer.self_tuning.filters cimport EXACT
from fhaosmo_ros.core.observer.self_tuning.jumps cimport watch
from fhaosmo_ros.core.observer.self_tuning.members cimport (
    CLOCKS, COLOURS, COUNT, DECAY, DIFFERENCES, Estimates, FIRST_SAMPLES, GRID, HALF, Line,
    Members, ORDERS, Shared, factorial, pair, power
)
from fhaosmo_ros.core.observer.self_tuning.noise cimport (
    LATTICE_SHARE, ROUNDED, differences, divided, follow_differences, is_multiple,
    share_of_stamps, usual_speed
)
from fhaosmo_ros.core.observer.self_tuning.weights cimport weigh

cdef double LEAST = 1e-150  # noise: its square is not 0
cdef double MEDIAN = 0.6745  # of |x| where x is normal with variance 1
# States may be so many times as large: a start that is too sure of them costs more than one that
# is not sure enough.
cdef double DOUBT = 10.0


cdef void gather(Members* m) noexcept nogil:
    """
    Collect the first samples; once there are enough, let the members begin (D 28).

    y may be constant until its sensor is ready: then the last constant one is the first of them.
    """
    cdef Shared* shared = &m.shared
    cdef double y = m.work.sample.y, largest = 0.0
    cdef int count = min(max(shared.samples, 1), FIRST_SAMPLES - 1), i
    if count == 1:
        m.first_y[0], m.first_h[0] = m.work.sample.before, 0.0
    if count > 1 or fabs(y - m.first_y[0]) > ROUNDED * fabs(y):
        m.first_y[count], m.first_h[count] = y, m.work.sample.h
        count += 1
    shared.samples = count
    if count < FIRST_SAMPLES:
        return
    for i in range(count):
        largest = fmax(largest, fabs(m.first_y[i]))
    begin(m, find_noise(m, fmax(1e-9 * largest, LEAST), largest))
    shared.samples = FIRST_SAMPLES + 1


cdef double find_quantum(const double* values, double least) noexcept nogil:
    """
    Return the smallest step above `least`; INFINITY if none is.

    Where others are no multiples, it may be one itself, of what they leave of it: 2 of 2, 3, 2, ..
    """
    cdef double quantum = INFINITY, step
    cdef int i
    for i in range(1, FIRST_SAMPLES):
        step = fabs(values[i] - values[i - 1])
        if step > least:
            quantum = fmin(quantum, step)
    for i in range(1, FIRST_SAMPLES):
        if share_of_multiples(values, quantum) < LATTICE_SHARE:
            quantum = divided(quantum, fabs(values[i] - values[i - 1]), values[i])
    return quantum


cdef double share_of_multiples(const double* values, double quantum) noexcept nogil:
    """Return the share of multiples of `quantum` among the steps; 1 if many samples repeat."""
    cdef double steps = 0.0, multiples = 0.0, step
    cdef int i
    for i in range(1, FIRST_SAMPLES):
        step = fabs(values[i] - values[i - 1])
        if step >= 0.99 * quantum:
            steps += 1.0
            multiples += is_multiple(step, quantum, values[i])
    return multiples / steps if steps > LATTICE_SHARE * (FIRST_SAMPLES - 1) else 1.0


cdef double period_of_bursts(const double* intervals, double mean) noexcept nogil:
    """Return the period of samples that come in bursts, from the first to the last whole one."""
    cdef double passed = 0.0, until = 0.0
    cdef int i, first = 0, last = 0
    for i in range(1, FIRST_SAMPLES):
        passed += intervals[i] if first > 0 else 0.0
        if intervals[i] > mean:
            first = first if first > 0 else i
            last, until = i, passed
    return until / (last - first) if last > first else mean


cdef double median(double* values, int count) noexcept nogil:
    """Return the median of `count` values; sorts these in place."""
    cdef double value
    cdef int i, j
    for i in range(1, count):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return values[count // 2]


cdef double find_noise(Members* m, double least, double largest) noexcept nogil:
    """
    Return the standard deviation of the noise on the first samples, at least `least`.

    Also write the quantum, how exact the stamps are, the mean interval, and what differences of y
    say that the noise is at most.
    """
    cdef Shared* shared = &m.shared
    cdef double found[DIFFERENCES]
    cdef double values[DIFFERENCES][FIRST_SAMPLES]
    cdef double rough[CLOCKS][DIFFERENCES]
    cdef double ages[CLOCKS][FIRST_SAMPLES]
    cdef double quantum = find_quantum(m.first_y, ROUNDED * largest), noise = INFINITY
    cdef double by_stamps = INFINITY, size, period = 0.0
    cdef int order, most, i, c, clock
    for i in range(1, FIRST_SAMPLES):
        period += m.first_h[i] / (FIRST_SAMPLES - 1)
        values[0][i - 1] = fabs(m.first_h[i] - m.first_h[i - 1])
    size = median(values[0] + 1, FIRST_SAMPLES - 2) / MEDIAN
    for i in range(1, FIRST_SAMPLES):
        values[1][i - 1] = m.first_h[i]
    shared.steady_period = period
    shared.usual_interval = median(values[1], FIRST_SAMPLES - 1)
    if values[1][FIRST_SAMPLES // 4] < 0.5 * period:
        shared.usual_interval = period_of_bursts(m.first_h, period)
    shared.jitter = fmax(size * size / 6.0, (EXACT * period) * (EXACT * period))
    ages[0][0] = ages[1][0] = 0.0
    for i in range(1, FIRST_SAMPLES):
        ages[0][i] = ages[0][i - 1] - period
        ages[1][i] = ages[1][i - 1] - fmax(m.first_h[i], EXACT * period)
    for clock in range(CLOCKS):
        for i in range(FIRST_SAMPLES - 1):
            most = min(m.n + 1, FIRST_SAMPLES - 1 - i)
            differences(m.first_y + i, ages[clock] + i, period, most, found)
            for order in range(1, most + 1):
                values[order][i] = fabs(found[order])
        for order in range(1, m.n + 2):
            size = median(values[order], FIRST_SAMPLES - order) / MEDIAN
            rough[clock][order] = size * size
            if size > 0.0:
                noise = fmin(noise, size)
                if clock:
                    by_stamps = fmin(by_stamps, size)
    if quantum < INFINITY:
        shared.quantum = quantum
        shared.lattice = share_of_multiples(m.first_y, quantum)
        if shared.lattice > LATTICE_SHARE:
            noise = fmax(quantum / sqrt(12.0), noise if noise < INFINITY else 0.0)
    if noise == INFINITY:
        noise = quantum if quantum < INFINITY else least
    noise = fmax(noise, least)
    for clock in range(CLOCKS):
        rough[clock][0] = 0.0
        for order in range(m.n + 2):
            for c in range(COLOURS):
                m.rough[clock][c][order] = fmax(rough[clock][order], noise * noise)
    for c in range(COLOURS):
        m.noise[c] = noise * noise
        m.late[c] = share_of_stamps(m, 1.0, by_stamps * by_stamps)
    return sqrt(noise * noise + m.late[0] * shared.jitter * usual_speed(m))


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
    """Let the members begin at the last sample (D 28)."""
    cdef Shared* shared = &m.shared
    cdef double y = m.first_y[FIRST_SAMPLES - 1], period = shared.steady_period
    cdef double omega, kappa, intensity, size, least = INFINITY, sizes = 0.0
    cdef int n = m.n, g, i, j, k, below, c
    find_sizes(m)
    shared.moving, shared.active = HALF, COUNT
    shared.unsettled = shared.flow_period = 0.0
    shared.first_noise = noise * noise
    for c in range(COLOURS):
        m.used_noise[c] = noise * noise
    for g in range(COUNT):
        c, omega = GRID.colour[g], GRID.bandwidth[g] / period
        m.kappa[g], m.correlation[g] = DECAY * omega, GRID.correlation[c]
        m.tau[g] = -period / log(GRID.correlation[c]) if c > 0 else 0.0
    memset(m.difference, 0, sizeof(m.difference))
    for j in range(n + 2):
        m.latest_y[j], m.ages[j] = m.first_y[0], j * period
    shared.roughness = 1.0
    for j in range(1, FIRST_SAMPLES):
        follow_differences(m, m.first_y[j], m.first_h[j])
    memset(m.flow, 0, sizeof(m.flow))  # of members that were lost it may be anything
    memset(m.decayed, 0, sizeof(Line))
    memset(&m.gain, 0, sizeof(Estimates))
    memset(&m.x, 0, sizeof(Estimates))
    memset(m.p.zz, 0, n * (n + 1) // 2 * sizeof(Line))
    memset(m.p.zd, 0, n * ORDERS * sizeof(Line))
    memset(m.p.dd, 0, sizeof(m.p.dd))
    memset(m.drive, 0, sizeof(m.drive))
    for g in range(COUNT):
        omega, kappa, k = GRID.bandwidth[g] / period, m.kappa[g], GRID.order[g]
        intensity = noise * noise * period * power(omega, 2 * (n + 1 + k))
        m.drive[k][g] = intensity
        m.x.z[0][g], m.p.zz[0][g] = y, noise * noise
        for i in range(1, n):
            m.p.zz[pair(i, i)][g] = m.sizes[i]
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
