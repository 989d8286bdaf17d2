# SPDX-License-Identifier: Apache-2.0
"""The noise of y, its quantum, and whether a sample is likely (D 29)."""

from libc.math cimport INFINITY, M_2_PI, erf, exp, fabs, fmax, fmin, round, sqrt

from fhaosmo_ros.core.observer.self_tuning.members cimport (
    CLOCKS, COLOURS, DIFFERENCES, EXACT, FIRST_SAMPLES, GRID, HALF, HUBER, Members, Sample,
    Shared, Work, fill, largest
)
from fhaosmo_ros.core.vectors cimport VECTORISED
from fhaosmo_ros.core.observer.structure cimport LOST_SAMPLES

# Variances of which one is so many times the other are different ones: who expects S of so many
# times the smallest one does not judge y, and noise of so many times that of rounding hides it.
cdef double APART = 3.0
# Mean of x^2 within HUBER where x is normal with variance 1: 2 % less than that of squares bounded
# so, for the noise is rather found too large.
cdef double CLIPPED = 1.0 - HUBER * sqrt(M_2_PI) * exp(-0.5 * HUBER * HUBER) / erf(
    HUBER / sqrt(2.0)
)
# The exponential of minus this is nothing. Members whose log-likelihood is so far below the best
# one do not say whether a sample is likely, and those so far below the best one of their colour do
# not tell the noise. In twice the log-likelihood, a jump of y has to be so much likelier than
# anything else, and another model than the one that is told. After so many time constants of a
# member its P is steady.
cdef double FADED = 8.0
cdef double SHORT_SHARE = 1.0 / LOST_SAMPLES  # of the last sample in short means
# If squared innovations over S are so much larger of late for every member that can judge, and
# squared differences of y are too, the noise has grown: both are averaged over QUICK_SAMPLES then.
# The steps of y always are. P is not the steady one if noise or the mean interval has changed so.
cdef double STEADY = 1.5, QUICK_SAMPLES = 40.0
# With a larger share of multiples of the quantum among the steps of y it is quantised.
cdef double LATTICE_SHARE = 0.9
cdef double ROUGH_SAMPLES = 100.0  # squared differences of y are averaged over so many
# Where intervals are uneven by more than this part of the period, so are the stamps: a host stamps
# a sample some microseconds late, by a little more or less for dozens of samples, and a y that is
# taken to be free of that would make a d of it.
cdef double PROMPT = 0.02
cdef double ROUNDED = 1e-12  # what is less than this part of a number may be an error of 64 bits
cdef double LEAST = 1e-150  # noise: its square is not 0
cdef double MEDIAN = 0.6745  # of |x| where x is normal with variance 1
# The variance of the noise is at most so many times what differences of y say. Where the highest
# ones are not so many times smaller than those of the order below, as variances of white noise,
# they are noise, for what is smooth has far smaller ones; then it is at least 1 / ROUGH^2 of them.
cdef double ROUGH = 2.0


cdef bint is_multiple(double step, double quantum, double y) noexcept nogil:
    """Return True if `step` is a multiple of `quantum`, up to the rounding of y to 32 bits."""
    cdef double tolerance = 1e-3 * quantum + 3e-7 * fabs(y)
    cdef double off = step - round(step / quantum) * quantum
    return tolerance < 0.1 * quantum and fabs(off) <= tolerance


cdef double divided(double quantum, double step, double y) noexcept nogil:
    """Return what a step that is no multiple leaves of the quantum, if that divides it."""
    cdef double left = fabs(step - round(step / quantum) * quantum)
    return left if not is_multiple(step, quantum, y) and is_multiple(quantum, left, y) else quantum


cdef void follow_quantum(Members* m) noexcept nogil:
    """
    Take a sample that is used: is the step to it a multiple of the quantum? (D 29).

    A step like the one before says nothing: so does y move at a constant speed. Another quantum is
    believed where it divides this one, or where y is not quantised by this one.
    """
    cdef Shared* shared = &m.shared
    cdef double y = m.work.sample.y, step = fabs(y - m.work.sample.before), change, smaller
    cdef bint fits
    if step <= ROUNDED * fabs(y):
        return
    change = fabs(m.latest_y[0] - 2.0 * m.latest_y[1] + m.latest_y[2])  # from the step before
    shared.goes_back += ((1.0 if change > 1.5 * step else 0.0) - shared.goes_back) / QUICK_SAMPLES
    fits = is_multiple(step, shared.quantum, y)
    if not fits:
        fits = is_multiple(shared.quantum, step, y)
        if fits or shared.lattice < LATTICE_SHARE:
            smaller = divided(shared.quantum, step, y)
            shared.quantum = smaller if smaller < shared.quantum else step
    if not fits:
        shared.lattice -= shared.lattice / QUICK_SAMPLES
    elif change > 0.5 * shared.quantum:
        shared.lattice += (1.0 - shared.lattice) / QUICK_SAMPLES


cdef double rounding(Members* m) noexcept nogil:
    """Return the variance of the error of rounding; 0 if y is not quantised, or noise hides it."""
    cdef double quanta = m.shared.quantum * m.shared.quantum / 12.0
    cdef bint hidden = APART * quanta < m.noise[0]
    return 0.0 if hidden or m.shared.lattice < LATTICE_SHARE else quanta


cdef void differences(
    const double* y, const double* ages, double unit, int order, double* found
) noexcept nogil:
    """
    Write divided differences of the samples 0 .. p, of order p = 1 .. `order` (D 29).

    Each is divided by what makes white noise count with its own variance.
    """
    cdef double weights[DIFFERENCES]
    cdef double total, square
    cdef int p, j
    weights[0] = 1.0
    for p in range(1, order + 1):
        weights[p] = 0.0
        for j in range(p):
            weights[j] *= unit / (ages[p] - ages[j])
            weights[p] -= weights[j]
        total = square = 0.0
        for j in range(p + 1):
            total += weights[j] * y[j]
            square += weights[j] * weights[j]
        found[p] = total / sqrt(square)


cdef double bound_of_noise(Members* m, int colour, int order) noexcept nogil:
    """Return what differences of an order say that the variance of the noise is at most."""
    return fmin(m.rough[0][colour][order], m.rough[1][colour][order])


cdef double least_rough(Members* m, int clock, int colour) noexcept nogil:
    """Return the smallest of what differences by a clock say that the variance is at most."""
    cdef double least = INFINITY
    cdef int p
    for p in range(1, m.n + 2):
        least = fmin(least, m.rough[clock][colour][p])
    return least


cdef bint is_even(Members* m) noexcept nogil:
    """Return True if y moves as if its samples were evenly spaced, rather than at their stamps."""
    return least_rough(m, 0, 0) < STEADY * least_rough(m, 1, 0)


cdef double usual_speed(Members* m) noexcept nogil:
    """Return the mean square of the speed of y of late, by its steps."""
    return 2.0 * m.rough[0][0][1] / (m.shared.steady_period * m.shared.steady_period)


cdef double share_of_stamps(Members* m, double share, double most) noexcept nogil:
    """
    Return a share of `jitter` that is error of the stamps, if y is off by `most` for it at most.

    Differences at the stamps have that in them.
    """
    cdef double prompt = PROMPT * m.shared.steady_period
    cdef double usual = fmax(m.shared.jitter * usual_speed(m), LEAST * LEAST)
    share = fmin(share, ROUGH * fmin(most / usual, 1.0))
    return fmax(share, fmin(prompt * prompt / m.shared.jitter, 1.0))


cdef void follow_differences(Members* m, double y, double h) noexcept nogil:
    """
    Follow what the differences of y say that the noise of each colour is at most (D 29).

    What y does besides adds to them, so that the smallest of the variances is an upper bound:
    of those of evenly spaced samples, if a host has stamped them late, and of those at the stamps,
    if they were taken late. In the sample, `roughness` is the square of the difference of the
    order that bounds white noise, over its usual size; `uneven` that of the highest one, as a
    variance of white noise: of the order of the noise if noise is why y is off its prediction, and
    far less if d has moved it there.
    """
    cdef Sample* sample = &m.work.sample
    cdef double even[DIFFERENCES]
    cdef double now[DIFFERENCES]
    cdef double least = ROUNDED * m.shared.first_noise, unit = m.shared.steady_period
    cdef double bound = INFINITY, white, r, grown, average = ROUGH_SAMPLES
    cdef double most = HUBER * HUBER, usual = CLIPPED
    cdef int p, c, clock, order = m.n + 1
    if m.shared.grown > STEADY:  # no outliers then, but noise of another size
        average, most, usual = QUICK_SAMPLES, 1.0 / ROUNDED, 1.0
    sample.roughness, sample.roughness_before = 0.0, m.shared.roughness
    for p in range(order, 0, -1):
        m.latest_y[p], m.ages[p] = m.latest_y[p - 1], m.ages[p - 1] + fmax(h, EXACT * unit)
        even[p] = p * unit
    m.latest_y[0] = y
    m.ages[0] = even[0] = 0.0
    for clock in range(CLOCKS):
        differences(m.latest_y, &m.ages[0] if clock else &even[0], unit, order, now)
        for p in range(1, order + 1):
            for c in range(COLOURS):
                white = now[p] - m.correlation[GRID.first[c]] * m.difference[clock][p]
                r = white * white / m.rough[clock][c][p]
                if clock == 1 and c == 0 and m.rough[1][0][p] < bound:
                    bound, sample.roughness = m.rough[1][0][p], r
                grown = 1.0 + (fmin(r, most) / usual - 1.0) / average
                m.rough[clock][c][p] = fmax(m.rough[clock][c][p] * grown, least)
            m.difference[clock][p] = now[p]
    sample.uneven = now[order] * now[order]
    m.shared.roughness += SHORT_SHARE * (
        fmin(sample.roughness, HUBER * HUBER) - m.shared.roughness
    )


cdef double periods(Members* m, double interval) noexcept nogil:
    """Return how many periods an interval is, at least one: samples in between were lost."""
    return fmax(round(interval / m.shared.usual_interval), 1.0)


cdef void follow_usual_interval(Members* m, double passed) noexcept nogil:
    """
    Follow the usual interval by the time that has passed for a sample that is used.

    Samples of a burst count together, until half of a usual interval has passed.
    """
    cdef Shared* shared = &m.shared
    cdef double usual
    shared.gathered += passed
    shared.waiting += 1.0
    if shared.gathered > 0.5 * shared.usual_interval:
        usual = shared.gathered / fmax(periods(m, shared.gathered), shared.waiting)
        shared.usual_interval += (usual - shared.usual_interval) / m.work.sample.average
        shared.gathered = shared.waiting = 0.0


cdef void follow_stamps(Members* m, double interval, double change) noexcept nogil:
    """
    Follow what changes of the interval say that the variance of the stamps is at most (D 29).

    Whole periods of lost samples do not count. `roughness` of the sample counts it, too: a single
    late stamp is seen there at once.
    """
    cdef Shared* shared = &m.shared
    cdef Sample* sample = &m.work.sample
    cdef double least = EXACT * shared.steady_period, r
    change -= (periods(m, interval) - periods(m, interval - change)) * shared.usual_interval
    r = change * change / (6.0 * shared.jitter)  # three stamps, one of them twice: 1 + 4 + 1
    sample.roughness = fmax(sample.roughness, r)
    shared.jitter *= 1.0 + (fmin(r, HUBER * HUBER) / CLIPPED - 1.0) / ROUGH_SAMPLES
    shared.jitter = fmax(shared.jitter, least * least)


cdef VECTORISED fill_noise(Members* m) noexcept nogil:
    """Write the variance of the noise at this sample: late stamps make y be off if it moves."""
    cdef Work* w = &m.work
    cdef int c
    for c in range(COLOURS):
        w.now[c] = m.noise[c] + m.late[c] * m.shared.of_stamps
    fill(w.noise, w.now)


cdef VECTORISED find_knowing(Members* m, bint unlikely_before) noexcept nogil:
    """
    Write the largest variance of the innovations with which a member can judge the sample.

    Members that have been found unlikely do not set it: without noise on y they expect innovations
    that are far too small. The likeliest one always can. While y is unlikely P grows, and the
    quick members would believe anything: S is believed up to a factor of 4 then.
    """
    cdef Work* w = &m.work
    cdef Py_ssize_t g, active = m.shared.active
    cdef double least, own, most = 4.0 if unlikely_before else INFINITY
    for g in range(active):
        w.believed[g] = w.s[g] if w.s[g] < most * m.variance[g] else most * m.variance[g]
        w.one[g] = -w.believed[g] * w.noise[g] if m.score[g] > -FADED else -INFINITY
    least = -largest(w.one, active)
    own = w.believed[m.shared.likeliest] * w.noise[m.shared.likeliest]
    w.sample.largest = fmax(APART * least, own)


cdef bint is_likely(Members* m, double gate, double late) noexcept nogil:
    """
    Return True if a member that can judge the sample finds it likely (D 29).

    A member that is unlikely itself would meet y by chance. A late stamp puts y off by `late`.
    """
    cdef Work* w = &m.work
    cdef double variance, off
    cdef int g
    for g in range(m.shared.active):
        variance = w.believed[g] * w.noise[g]
        off = fmax(fabs(w.b[g]) - late, 0.0)
        if variance <= w.sample.largest and m.score[g] > -FADED and (
            off * off <= gate * gate * variance
        ):
            return True
    return False


cdef VECTORISED follow_noise(Members* m) noexcept nogil:
    """
    Follow the noise of y of each colour, by the innovations of its likeliest members (D 29).

    `grown` is how much larger than expected squared innovations have been of late,
    for every member, and squared differences too: more than 1 while the noise grows.
    """
    cdef Work* w = &m.work
    cdef Sample* sample = &w.sample
    cdef double best[COLOURS]
    cdef double weights[COLOURS]
    cdef double squares[COLOURS]
    cdef double variance, ratio, off, weight, most, more, share, rest, by_stamps
    cdef double average = sample.average, widest = sample.largest
    cdef double floor = fmax(sample.quanta, EXACT * EXACT * m.rough[0][0][1])
    cdef int c
    cdef Py_ssize_t g, active = m.shared.active
    for g in range(active):
        variance = w.believed[g] * w.noise[g]
        ratio = w.b[g] * w.b[g] / variance
        ratio = ratio if ratio < HUBER * HUBER else HUBER * HUBER
        m.short_mean[g] += SHORT_SHARE * (ratio - m.short_mean[g])
        w.ratio[g] = ratio
        w.one[g] = -m.short_mean[g] if variance <= widest else -INFINITY
    m.shared.grown = fmax(fmin(m.shared.roughness, -largest(w.one, active)), 1.0)
    for c in range(COLOURS):
        best[c], weights[c], squares[c] = -INFINITY, 0.0, 0.0
    best[0] = largest(m.score, HALF)
    for g in range(HALF, active):
        c = GRID.colour[g]
        best[c] = m.score[g] if m.score[g] > best[c] else best[c]
    for g in range(active):
        c = GRID.colour[g]
        off = m.score[g] - best[c]
        if off > -FADED:
            weight = exp(off) if off < 0.0 else 1.0
            weights[c] += weight
            squares[c] += weight * w.ratio[g]
    if m.shared.grown > STEADY:
        average = fmin(average, QUICK_SAMPLES)
    for c in range(COLOURS if active > HALF else 1):
        more = (squares[c] / weights[c] / CLIPPED - 1.0) / average
        share = m.noise[c] / w.now[c]  # who adds to the noise answers for it
        m.late[c] *= 1.0 + (1.0 - share) * more
        m.noise[c] *= 1.0 + share * more
        by_stamps = least_rough(m, 1, c)
        most = fmin(least_rough(m, 0, c), by_stamps)
        m.late[c] = share_of_stamps(m, m.late[c], by_stamps)
        m.noise[c] = fmax(fmin(m.noise[c], ROUGH * most), floor)
        rest = bound_of_noise(m, c, m.n + 1)
        if ROUGH * rest > bound_of_noise(m, c, m.n):
            m.noise[c] = fmax(m.noise[c], rest / (ROUGH * ROUGH))
    fill_noise(m)


# The first samples

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


cdef double find_noise(Members* m) noexcept nogil:
    """
    Return the standard deviation of the noise on the first samples.

    Also write the quantum, how exact the stamps are, the mean interval, and what differences of y
    say that the noise is at most.
    """
    cdef Shared* shared = &m.shared
    cdef double found[DIFFERENCES]
    cdef double values[DIFFERENCES][FIRST_SAMPLES]
    cdef double ages[CLOCKS][FIRST_SAMPLES]
    cdef double quantum, noise = INFINITY, by_stamps = INFINITY, size = 0.0, period = 0.0, least
    cdef int order, most, i, c, clock
    for i in range(FIRST_SAMPLES):
        size = fmax(size, fabs(m.first_y[i]))
    least, quantum = fmax(1e-9 * size, LEAST), find_quantum(m.first_y, ROUNDED * size)
    for i in range(1, FIRST_SAMPLES):
        period += m.first_h[i] / (FIRST_SAMPLES - 1)
        values[0][i - 1], values[1][i - 1] = fabs(m.first_h[i] - m.first_h[i - 1]), m.first_h[i]
    size = median(values[0] + 1, FIRST_SAMPLES - 2) / MEDIAN
    shared.steady_period = period
    shared.usual_interval = median(values[1], FIRST_SAMPLES - 1)
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
            m.rough[clock][0][order] = size * size
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
        for order in range(m.n + 2):
            for c in range(COLOURS):
                m.rough[clock][c][order] = fmax(m.rough[clock][0][order], noise * noise)
    for c in range(COLOURS):
        m.noise[c] = noise * noise
        m.late[c] = share_of_stamps(m, 1.0, by_stamps * by_stamps)
    return sqrt(noise * noise + m.late[0] * shared.jitter * usual_speed(m))
