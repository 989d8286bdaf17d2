# SPDX-License-Identifier: Apache-2.0
"""
Jumps: of d (D 33), and of y that are too small to be lost samples and that no d explains (D 35).

After a jump of d y is farther and farther off. A sensor that slips puts an offset on y. A few
samples of it are enough for quick members to become likely, whose d explains anything, and is
larger by orders of magnitude. So the innovations of the member that was likely are tested for a
mean (Willsky and Jones 1976).
"""

from libc.math cimport INFINITY, fabs, fmax, fmin, log, pow, sqrt
from libc.string cimport memcpy, memset

from fhaosmo_ros.core.observer.self_tuning.members cimport (
    COUNT, GRID, HALF, HUBER, INEXACT, MOST_STATES, ORDERS, WINDOW, Line, Members, Sample,
    Shared, Work, by_binomials, entry, factorial, fill, power, put, state
)
from fhaosmo_ros.core.observer.self_tuning.noise cimport FADED, ROUGH
from fhaosmo_ros.core.observer.structure cimport GATE, LOST_SAMPLES
from fhaosmo_ros.core.vectors cimport VECTORISED

# Where unlikely samples are farther off than the first one, d may have jumped (D 33). Farther
# means: so many times as far at least, and 3 sigma more; and so many times the highest differences
# of y, which noise does not get to. Differences must not have been larger than usual before, but
# where y is farther off by the last factor.
cdef double FARTHER = 1.3, SMOOTH = 5.0, SMOOTHEST = 30.0


# Of d

cdef void begin_growth(Members* m) noexcept nogil:
    """Take the first of the unlikely samples in a row."""
    m.shared.first_off, m.shared.first_off_after = fabs(m.work.sample.off), m.work.sample.h
    m.shared.uneven, m.shared.first_rough = m.work.sample.uneven, m.work.sample.roughness_before


cdef double growth(Members* m) noexcept nogil:
    """
    Return by what factor y is farther off than at the sample before, at least, after a jump of d.

    A jump of d puts y off by tau^n, and a blow by tau^(n - 1), in a time tau that begins after the
    last sample that was likely, when y was within the gate (D 33). A y that freezes while it moves
    is off by tau, and one that has an offset by the same all the time.
    """
    cdef Shared* shared = &m.shared
    cdef double gate = fmin(GATE * sqrt(m.work.now[0]) / shared.first_off, 1.0)
    cdef double hidden = pow(gate, 1.0 / m.n), first = shared.first_off_after
    cdef double now = m.work.sample.h, before = shared.latest_off_after
    return power((now + hidden * (first - now)) / (before + hidden * (first - before)), m.n - 1)


cdef bint has_jumped(Members* m, double beyond) noexcept nogil:
    """
    Return True if unlikely samples are farther and farther off, so that d has jumped (D 33).

    `beyond` samples in a row before this one were unlikely. Two samples say how large the jump is;
    each more that is as smooth speaks for it. Jumps of twice the size are four times as rare, so
    that a larger one than usual takes more of them. In the sample, `since_jump` is the time since
    then.
    """
    cdef Shared* shared = &m.shared
    cdef Sample* sample = &m.work.sample
    cdef double off = fabs(sample.off), uneven, hidden, jump, noise
    cdef int count = <int>fmin(beyond, LOST_SAMPLES)
    if count == 0:
        begin_growth(m)
    shared.uneven += (sample.uneven - shared.uneven) / (count + 1.0)
    uneven = sqrt(shared.uneven)
    noise = HUBER * sqrt(m.work.now[0])
    if (
        count > 0 and off > SMOOTH * uneven and off > FARTHER * shared.first_off + noise
        and off > growth(m) * shared.latest_off - noise
    ):
        shared.growing += 1.0
    else:
        shared.growing = 0.0
    shared.latest_off, shared.latest_off_after = off, sample.h
    if shared.growing == 0.0 or (
        shared.first_rough >= ROUGH and off <= SMOOTHEST * uneven
    ):
        return False
    # So far off y may have been when the jump began.
    hidden = fmin(GATE * sqrt(m.work.now[0]), shared.first_off) / off
    sample.since_jump = sample.h / (1.0 - pow(hidden, 1.0 / m.n))
    jump = off * factorial(m.n) / power(sample.since_jump, m.n)
    jump = log(jump / (2.0 * sqrt(shared.size_of_d)))  # usual: from one value to its opposite
    return (shared.growing - 1.0) * log(off / uneven) > 2.0 * jump


cdef VECTORISED allow_jump(Members* m, double tau) noexcept nogil:
    """
    Let the members believe that d has jumped: raise P as far as the sample asks for it (D 33).

    It was `tau` ago; 0 for the samples that follow, for which P knows what is uncertain. What the
    noise was before does not count, so that coloured noise begins afresh. Innovations, their
    variances, and the predicted P and P C' are replaced.
    """
    cdef Work* w = &m.work
    cdef int n = m.n, i, j
    cdef Py_ssize_t g, active = m.shared.active
    cdef double y = w.sample.y, part, variance, square
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


# Of y

cdef void watch(Members* m, int member) noexcept nogil:
    """Begin to follow the innovations of a member."""
    memset(m.window, 0, sizeof(m.window))
    m.shared.followed, m.shared.since_mark = member, 0
    memcpy(m.score_before[0], m.score, sizeof(Line))
    memcpy(m.score_before[1], m.score, sizeof(Line))


cdef void follow_innovations(Members* m) noexcept nogil:
    """
    Take a sample into the window.

    Only of members with white noise, since coloured noise explains jumps; and of a y that is not
    quantised, whose errors of rounding have a mean for many samples.
    """
    cdef Shared* shared = &m.shared
    cdef int g = shared.followed, j
    if m.work.sample.quanta > 0.0 or GRID.colour[g] > 0:
        memset(m.window, 0, sizeof(m.window))
    else:
        for j in range(WINDOW - 1):
            m.window[j] = m.window[j + 1]
        m.window[WINDOW - 1] = m.work.b[g] / sqrt(m.work.s[g] * m.work.now[0])
    shared.since_mark += 1
    if shared.since_mark % WINDOW == 0:
        shared.since_mark = WINDOW
        memcpy(m.score_before[1], m.score_before[0], sizeof(Line))
        memcpy(m.score_before[0], m.score, sizeof(Line))


cdef int samples_since_jump(Members* m) noexcept nogil:
    """Return for how many samples y has been off by a constant (D 35); 0 if it is not."""
    cdef Shared* shared = &m.shared
    cdef double best = 0.0, total = 0.0, gained, most = 0.0, coloured = -INFINITY
    cdef double* before
    cdef int first = 0, g, j, count
    for j in range(WINDOW - 1, -1, -1):
        total += m.window[j]
        if total * total > best * (WINDOW - j):
            best, first = total * total / (WINDOW - j), j
    count = WINDOW - first
    if (best <= HUBER * HUBER or first < WINDOW // 2) and shared.followed != shared.told:
        memset(m.window, 0, sizeof(m.window))
        shared.followed = shared.told
        return 0
    g = shared.followed
    if best <= GATE * GATE or first < WINDOW // 2 or GRID.bandwidth[g] * WINDOW > 1.0:
        return 0
    # Too soon after a jump rather d explains both.
    if shared.since_mark < WINDOW or best <= otherwise(m.window, m.n) + FADED:
        return 0
    before = &m.score_before[0 if shared.since_mark % WINDOW >= count else 1][0]
    gained = m.score[g] - before[g]
    for j in range(HALF):
        most = fmax(most, 2.0 * (m.score[j] - before[j] - gained))
    for j in range(HALF, COUNT):
        coloured = fmax(coloured, 2.0 * (before[j] - before[g]))
    return count if best > most + FADED and coloured < -FADED else 0


cdef double otherwise(const double* r, int n) noexcept nogil:
    """
    Return how well anything but a jump explains innovations: twice the gain of log-likelihood.

    Powers, up to n, of the time since any sample of the window, as a d that has jumped gives them;
    and noise that has grown since any sample.
    """
    cdef double most = 0.0, squares = 0.0, along, shape, size
    cdef int j, m, count, degree
    for m in range(WINDOW - 1, -1, -1):
        count = WINDOW - m
        squares += r[m] * r[m]
        most = fmax(most, squares - count * (1.0 + log(fmax(squares / count, 1.0))))
        for degree in range(1, n + 1 if count > 1 else 1):
            along = size = 0.0
            for j in range(m, WINDOW):
                shape = 1.0
                for _ in range(degree):
                    shape *= j - m + 1
                along += shape * r[j]
                size += shape * shape
            most = fmax(most, along * along / size)
    return most


cdef void follow_jump(Members* m, int count) noexcept nogil:
    """Let all members go on from the one that is followed, as if only z_1 had jumped (D 35)."""
    cdef double estimate[MOST_STATES]
    cdef double variance = m.work.s[m.shared.followed] * m.work.now[0], total = 0.0
    cdef int n = m.n, g = m.shared.followed, i
    for i in range(WINDOW - count, WINDOW):
        total += m.window[i] * sqrt(variance)
    for i in range(n + ORDERS):  # nothing of the jump is in z or d
        estimate[i] = state(&m.x, n, i)[g] - total * state(&m.gain, n, i)[g]
    estimate[0] += total / count
    by_binomials(estimate + n, ORDERS, -m.kappa[g])
    for g in range(COUNT):
        put(m, g, estimate)
        m.p.zz[0][g] += variance / count
        m.residual[g], m.far[g] = m.work.sample.y - estimate[0], 0.0
    memcpy(m.score, m.score_before[1], sizeof(Line))
    m.shared.unsettled = 0.0
    watch(m, m.shared.followed)


cdef void shift(Members* m, double of_state, double miss, double variance) noexcept nogil:
    """
    Let all members go on after a jump of y that has lost it (D 23).

    z_1 is another one by `of_state`; 0 where y's offset is. The innovation which told the jump is
    `miss`, and `variance` is its own.
    """
    cdef int g
    for g in range(COUNT):
        m.x.z[0][g] += of_state
        m.p.zz[0][g] += variance
    for g in range(m.n + 2):
        m.latest_y[g] += of_state - miss
    m.shared.unsettled = m.shared.growing = 0.0
    watch(m, m.shared.followed)
