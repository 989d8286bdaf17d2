# SPDX-License-Identifier: Apache-2.0
"""
The members where y is quantised: a sample says within which interval z_1 lies (D 31, D 36).

Estimate and covariance become those of the normal distribution with the mean and the variance that
the truncated one has (Curry, Vander Velde and Potter 1970, IEEE Transactions on Information Theory
16, 152-161).
"""

from libc.math cimport M_2_PI, M_PI, copysign, erf, exp, fabs, fmax, log, sqrt
from libc.stdlib cimport calloc, free

from fhaosmo_ros.core.observer.self_tuning.members cimport (
    COLOURS, COUNT, GRID, HALF, HUBER, INEXACT, Members, Work, entry, go_on_from, leeway
)
from fhaosmo_ros.core.observer.self_tuning.weights cimport FLOOR, KEPT
from fhaosmo_ros.core.vectors cimport VECTORISED
from fhaosmo_ros.core.observer.structure cimport GATE

cdef enum:
    SQUARINGS = 10  # for an exponential
cdef double ROOT = sqrt(2.0 * M_PI)
cdef double FARTHEST = 12.0  # standard deviations; numbers that are farther off count as so far
# Part of the quantum by which predictions of z_1 are less certain than their P says. In an
# interval of twice so few standard deviations the density is taken to be constant.
cdef double VAGUE = 0.1
# Logarithms of the least probability that a sample counts with, by HUBER as without quanta, and of
# the least one with which z_1 passes an edge at just this sample.
cdef double LEAST_CHANCE = -0.5 * HUBER * HUBER, LEAST_PASSAGE = 2.0 * LEAST_CHANCE
# That probability is so small that it has to be found from the speed if z_1 moves, squared, by
# less than this part of its variance.
cdef double SLOW = 0.1
# A repeated sample counts for what is less likely than this, and for z_1 not passing an edge.
cdef double HALF_SURE = log(0.5)
# A normal number with the variance of an even distribution in the interval lies in it with this
# probability.
cdef double EVENLY = log(erf(sqrt(1.5)))


# The normal distribution by additions and multiplications alone, which become vector instructions:
# a call of the C library's `erfc` or `exp` for each member took almost half of the time of a step.

cdef inline double exponential(double x) noexcept nogil:
    """Return exp(x) for x <= 0, as exact as 1e-12; that of -100 for less."""
    cdef double part = (x if x > -100.0 else -100.0) / (1 << SQUARINGS)
    cdef double value = 1.0 + part * (1.0 + part * (1.0 / 2.0 + part * (1.0 / 6.0 + part * (
        1.0 / 24.0 + part * (1.0 / 120.0 + part * (1.0 / 720.0 + part * (
            1.0 / 5040.0 + part * (1.0 / 40320.0))))))))  # Taylor's series
    for _ in range(SQUARINGS):
        value *= value
    return value


cdef inline double mills(double x) noexcept nogil:
    """
    Return the probability beyond x over the density at x, for 0 <= x <= 12.

    That is Mills' ratio, as the polynomial in t that interpolates it at Chebyshev's points; the
    relative error is below 1e-11. Such bilinear maps: Schonfelder (1978, Mathematics of
    Computation 32, 1232-1240).
    """
    cdef double t = (x - 3.0) / (x + 3.0)
    return 0.3045902987095838 + t * (-0.5173746232311449 + t * (0.30887914470292704 + t * (
        -0.11583995847360465 + t * (0.015374049749167167 + t * (0.0072840323120163634 + t * (
            -0.0024836316153585146 + t * (-0.0008660764594113701 + t * (
                0.0003295999539117723 + t * (0.00017104118530309348 + t * (
                    -3.1458797321512514e-05 + t * (-3.6862949358524404e-05 + t * (
                        -2.570523517307792e-06 + t * (5.336824555584937e-06
                                                      + t * 1.5943454804208586e-06)))))))))))))


# What a sample tells

cdef VECTORISED truncate(Members* m, double half, double least) noexcept nogil:
    """
    Find what is known of the members' z_1 if it lies within `half` a quantum of a sample.

    That is what is known of a normal number of mean 0 and variance 1 that lies between two others:
    its `mean`, by what its variance is smaller than 1 (`lost`), and the logarithm of the
    probability that it lies there (`chance`). `size` is the standard deviation of which these are
    parts; `least` is added to the variance of z_1. From it follow `b` and its factors.
    """
    cdef Work* w = &m.work
    cdef double inverse, off, width, near, far, to_near, left, right, beyond, share, by_near
    cdef double center, less, square
    cdef double tail = GATE
    cdef Py_ssize_t g, active = m.shared.active
    for g in range(active):
        w.size[g] = sqrt(INEXACT * (w.p.zz[0][g] + least))
        inverse = 1.0 / w.size[g]
        off, width = fabs(w.b[g]) * inverse, half * inverse
        near, far = off - width, off + width
        far = far if far < FARTHEST else FARTHEST
        to_near = fabs(near)
        to_near = to_near if to_near < FARTHEST else FARTHEST
        left, right = exponential(-0.5 * to_near * to_near), exponential(-0.5 * far * far)
        beyond = left * mills(to_near)
        share = (beyond if near > 0.0 else ROOT - beyond) - right * mills(far)
        inverse, by_near = 1.0 / share, 1.0 / near
        center = (left - right) * inverse
        less = center * center - (near * left - far * right) * inverse
        # In a narrow interval the density is constant; one beyond the gate is its nearer end, and
        # one that has both its edges beyond it is certain.
        share = share if near > -tail else ROOT
        share = share if near < tail else ROOT
        share = share if width > VAGUE else 2.0 * width
        w.chance[g] = share / ROOT
        square = near * near if near > tail else 0.0
        w.one[g] = square if width > VAGUE else off * off
        center = center if near < tail else near + by_near
        center = center if width > VAGUE else off
        center = copysign(center, w.b[g])
        w.mean[g] = center if near > -tail else 0.0
        less = less if near < tail else 1.0 - by_near * by_near
        less = less if width > VAGUE else 1.0 - width * width / 3.0
        less = less if less > 0.0 else 0.0
        less = less if less < 1.0 else 1.0
        w.lost[g] = less if near > -tail else 0.0
    for g in range(active):
        share = (log(w.chance[g]) if w.chance[g] != 1.0 else 0.0) - 0.5 * w.one[g]
        w.chance[g] = share if share > LEAST_CHANCE else LEAST_CHANCE
    for g in range(active):
        m.far[g] = m.far[g] + 1.0 if w.one[g] > tail * tail else 0.0
        off = HUBER * leeway(m.far[g])
        center = w.mean[g] if w.mean[g] > -off else -off
        center = center if center < off else off
        w.b[g] = center * w.size[g]
        w.inverse[g] = 1.0 / (w.size[g] * w.size[g])
        w.taken[g] = w.lost[g] * w.inverse[g]


cdef inline double passage(
    double to_edge, double variance, double moved, double spread
) noexcept nogil:
    """
    Return the probability that a normal number passes an edge above it between two samples.

    By the mean rate of upcrossings, density times mean speed (D 36, Rice 1945): the mean of v
    where v > 0 and of 0 elsewhere, for a normal v, is about (m + sqrt(m^2 + 2 s^2 / pi)) / 2. m is
    how far it has `moved`, and s^2 how far that is `spread`; noise on each sample counts twice.
    """
    cdef double density = exponential(-0.5 * to_edge * to_edge / variance)
    density /= ROOT * sqrt(variance)
    return density * 0.5 * (moved + sqrt(moved * moved + M_2_PI * spread))


cdef VECTORISED stay(
    Members* m, const double* speed, double half, double least, double carried
) noexcept nogil:
    """
    Let a sample that comes again tell that z_1 has passed neither edge (D 36).

    That z_1 is in the interval was known before: who takes it for news at each sample is soon sure
    of something wrong. So the sample corrects a member by the share that the log-likelihood of
    passing neither edge has in that of the interval; and at least until the variance of z_1 is
    what it can be within two edges (Popoviciu 1935).
    """
    cdef Work* w = &m.work
    cdef double before = w.sample.before, h = w.sample.h, most = half * half
    cdef double z, moved, variance, spread, passed, chance, share, least_share
    cdef bint slow
    cdef Py_ssize_t g, active = m.shared.active
    for g in range(active):
        z, variance = m.x.z[0][g], m.p.zz[0][g] + least
        moved = w.x.z[0][g] - z
        spread = h * h * speed[g] + carried
        passed = passage(before + half - z, variance, moved, spread)
        passed += passage(z + half - before, variance, -moved, spread)
        slow = moved * moved + spread < SLOW * variance
        passed = passed if slow else 0.0
        chance = w.chance[g] - (HALF_SURE if slow else EVENLY)  # who expects it loses nothing
        chance = chance if chance < -passed else -passed
        share = chance / w.chance[g] if w.chance[g] < chance else 1.0
        least_share = (1.0 - most * w.inverse[g]) / w.lost[g] if w.lost[g] > 0.0 else 0.0
        share = share if share > least_share else least_share
        share = share if share < 1.0 else 1.0
        w.b[g] *= share
        w.taken[g] *= share
        w.chance[g] = chance


cdef VECTORISED go_on(
    Members* m, const double* speed, double half, double least, double carried
) noexcept nogil:
    """Bound `chance` of a step by one quantum by that of z_1 passing the edge just now (D 36)."""
    cdef Work* w = &m.work
    cdef double before = w.sample.before, h = w.sample.h
    cdef double side = copysign(1.0, w.sample.y - before), least_passed = exp(LEAST_PASSAGE)
    cdef double z, moved, variance, passed, spread
    cdef Py_ssize_t g, active = m.shared.active
    for g in range(active):
        z, variance = m.x.z[0][g], m.p.zz[0][g] + least
        moved = side * (w.x.z[0][g] - z)
        spread = h * h * speed[g] + carried
        passed = passage(side * (before - z) + half, variance, moved, spread)
        passed = passed if passed < 1.0 else 1.0
        w.one[g] = passed if moved * moved + spread < SLOW * variance else 1.0
    for g in range(active):
        passed = log(w.one[g]) if w.one[g] > least_passed else LEAST_PASSAGE
        w.chance[g] = w.chance[g] if w.chance[g] < passed else passed


cdef VECTORISED take_interval(Members* m) noexcept nogil:
    """
    Take a quantised sample into the log-likelihoods, and find how it corrects members (D 31).

    For `correct` and `correct_states`. Members with coloured noise do not take part.
    """
    cdef Work* w = &m.work
    cdef Py_ssize_t g, active = m.shared.active
    cdef double y = w.sample.y, before = w.sample.before, half = sqrt(3.0 * w.sample.quanta)
    cdef double vague = 2.0 * VAGUE * half, kept = KEPT
    # Noise that is not of rounding, and what no P knows.
    cdef double least = fmax(w.now[0] - w.sample.quanta, 0.0) + vague * vague
    # Noise that is far smaller than the quantum shows where it carries z_1 over an edge and back.
    cdef double carried = 2.0 * m.shared.goes_back * least
    cdef double* speed = entry(&m.p, m.n, 1, 1)  # variance of the state behind z_1
    truncate(m, half, least)
    if y == before:
        stay(m, speed, half, least, carried)
    elif fabs(y - before) < 3.0 * half:
        go_on(m, speed, half, least, carried)
    for g in range(active):
        m.score[g] = m.prior[g] + kept * (m.score[g] - m.prior[g]) + (
            w.chance[g] if w.chance[g] < 0.0 else 0.0
        )


cdef bint choose_members(Members* m) noexcept nogil:
    """
    Choose who takes part: where y is quantised, those with white noise (D 31).

    Errors of rounding are not coloured noise. When y is quantised no more, members with coloured
    noise go on from those with white noise. Return True if it is others than before.
    """
    cdef int before = m.shared.active, i, g
    m.shared.active = HALF if m.work.sample.quanta > 0.0 else COUNT
    if m.shared.active < before:
        for g in range(HALF, COUNT):
            m.weight[g], m.score[g] = 0.0, -FLOOR
    elif m.shared.active > before:
        m.shared.unsettled = 0.0
        for i in range(COLOURS):
            m.noise[i] = m.used_noise[i] = m.noise[0]
            m.late[i] = m.late[0]
        for g in range(HALF, COUNT):
            go_on_from(m, g, GRID.white[g])
    return m.shared.active != before


# What Python can ask, a number at a time

def within(double low, double high):
    """
    Return what `truncate` finds of a normal number of variance 1 between two others.

    Returns
    -------
    (float, float, float)
        Logarithm of the probability (at least `LEAST_CHANCE`), mean, what the variance loses.

    """
    cdef Members* m = <Members*>calloc(1, sizeof(Members))
    if m == NULL:
        raise MemoryError
    m.n = m.shared.active = 1
    m.work.b[0], m.work.p.zz[0][0] = 0.5 * (low + high), 1.0
    truncate(m, 0.5 * (high - low), 0.0)
    found = m.work.chance[0], m.work.mean[0], m.work.lost[0]
    free(m)
    return found
