# SPDX-License-Identifier: Apache-2.0
"""The members as filters: prediction and correction of estimates and covariances (D 27)."""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.self_tuning.members import (
    COLOUR,
    CORRELATION,
    COUNT,
    DECAYED,
    FACTORIALS,
    FAST,
    fill,
    grid,
    IN_BAND,
    INTENSITY,
    KAPPA,
    Members,
    ORDERS,
    repeat,
    RESIDUAL,
    Scratch,
    SQUARE,
    USED,
    VARIANCE,
)

HUBER = 3.0
"""Innovations of more standard deviations count as so many (Huber 1964)."""
INEXACT = 1.0 + 1e-10
"""
By this factor S is too large, so that P stays positive where y is by many orders of magnitude more
exact than its prediction: what is left of P then is more than what rounding makes of it.
"""


@compiled(forceinline=True)
def at(d: int, i: int, j: int) -> int:
    """Return the row of P_ij, i <= j, in an upper triangle of d rows."""
    return i * d - i * (i - 1) // 2 + j - i


@compiled(forceinline=True, fastmath=FAST)
def add_scaled(row: Floats, factor: float, other: Floats, columns: int) -> None:
    """Add `other` times a factor, which is often 0, to the first columns of a row."""
    if factor != 0.0:
        for g in range(columns):
            row[g] += factor * other[g]


@compiled(fastmath=FAST)
def predict_states(
    members: Members, n: int, k: int, h: float, mean: Floats, predicted: Floats, ahead: Floats
) -> None:
    """Predict the members' estimates: the mean's path, plus the flow of their deviations."""
    flow, kappa, decayed = members.flow, members.rates[KAPPA], members.rates[DECAYED]
    x = members.x[k]
    d, rate, second = x[n], x[n + min(k, 1)], x[n + k]
    for i in range(n):
        base = predicted[i]
        for j in range(n + ORDERS):
            base -= flow[i, j] * mean[j]
        row, f0, f1, f2 = ahead[i], flow[i, n], flow[i, n + 1], flow[i, n + 2]
        for g in range(COUNT):
            c = kappa[g]
            row[g] = base + (f0 - c * (f1 - c * f2)) * d[g]
        if k > 0:
            for g in range(COUNT):
                row[g] += (f1 - 2.0 * kappa[g] * f2) * rate[g]
        if k > 1:
            for g in range(COUNT):
                row[g] += f2 * second[g]
        for j in range(n):
            add_scaled(row, flow[i, j], x[j], COUNT)
    for i in range(k + 1):  # exp of D 17: e^(-kappa h) times a polynomial
        row, other = ahead[n + i], x[n + i]
        for g in range(COUNT):
            row[g] = decayed[g] * other[g]
        for j in range(i + 1, k + 1):
            factor, other = h ** (j - i) / FACTORIALS[j - i], x[n + j]
            for g in range(COUNT):
                row[g] += decayed[g] * factor * other[g]


@compiled(forceinline=True, fastmath=FAST)
def add_chain(
    row: Floats,
    share: float,
    intensity: Floats,
    chain: Floats,
    first: int,
    terms: int,
    one: Floats,
    two: Floats,
    three: Floats,
    moving: int,
) -> None:
    """Begin a sum: a share of the intensity, and up to three terms with weights of `chain`."""
    a, b, c = chain[first], chain[first + min(1, terms - 1)], chain[first + terms - 1]
    if terms == 1:
        for g in range(moving):
            row[g] = share * intensity[g] + a[g] * one[g]
    elif terms == 2:
        for g in range(moving):
            row[g] = share * intensity[g] + a[g] * one[g] + b[g] * two[g]
    else:
        for g in range(moving):
            row[g] = share * intensity[g] + a[g] * one[g] + b[g] * two[g] + c[g] * three[g]


@compiled(fastmath=FAST)
def predict_covariances(
    members: Members, n: int, k: int, h: float, ahead: Floats, rest: Floats, moving: int
) -> None:
    """Write A P A' + Q of the members that move (D 27) to `ahead`."""
    p, flow = members.p[k], members.flow
    kappa, decayed = members.rates[KAPPA], members.rates[DECAYED]
    intensity, d = members.record[INTENSITY, k], n + 1 + k
    product = grid(rest, 0, d * d, moving)  # A P
    # By what d and its derivatives act on each z, and in the last rows on d itself (D 17)
    chain = grid(rest, d * d * moving, (n + 1) * (k + 1), moving)
    for i in range(n):
        f0, f1, f2 = flow[i, n], flow[i, n + 1], flow[i, n + 2]
        first = chain[i * (k + 1)]
        for g in range(moving):
            first[g] = f0 - kappa[g] * (f1 - kappa[g] * f2)
        if k > 0:
            second = chain[i * (k + 1) + 1]
            for g in range(moving):
                second[g] = f1 - 2.0 * kappa[g] * f2
        if k > 1:
            chain[i * (k + 1) + 2] = f2
    for i in range(k + 1):
        row, factor = chain[n * (k + 1) + i], h**i / FACTORIALS[i]
        for g in range(moving):
            row[g] = factor * decayed[g]
    lowest = d
    for i in range(d - 1, -1, -1):  # A has zeros below its diagonal, most of them
        lowest = min(lowest, i)
        for m in range(i if i < n else 0):
            if flow[i, m] != 0.0:
                lowest = min(lowest, m)
        for j in range(lowest, d):
            row, a = product[i * d + j], max(n, i)
            terms, e, f = d - a, min(a + 1, d - 1), min(a + 2, d - 1)
            one = p[at(d, min(j, a), max(j, a))]
            two, three = p[at(d, min(j, e), max(j, e))], p[at(d, min(j, f), max(j, f))]
            first_weight = min(i, n) * (k + 1)
            add_chain(row, 0.0, intensity, chain, first_weight, terms, one, two, three, moving)
            for m in range(n if i < n else 0):
                add_scaled(row, flow[i, m], p[at(d, min(j, m), max(j, m))], moving)
    for i in range(d):  # .. A' + Q, Q as in D 20
        for j in range(i, d):
            below = 2 * d - 2 - i - j
            share = h ** (below + 1) / (below + 1)
            share /= FACTORIALS[d - 1 - i] * FACTORIALS[d - 1 - j]
            row, a = ahead[at(d, i, j)], max(n, j)
            terms = d - a
            one = product[i * d + a]
            two, three = product[i * d + min(a + 1, d - 1)], product[i * d + min(a + 2, d - 1)]
            first_weight = min(j, n) * (k + 1)
            add_chain(row, share, intensity, chain, first_weight, terms, one, two, three, moving)
            for m in range(n if j < n else 0):
                add_scaled(row, flow[j, m], product[i * d + m], moving)


@compiled(fastmath=FAST)
def expect_innovations(
    members: Members, n: int, k: int, h: float, p: Floats, gain: Floats, s: Floats, moving: int
) -> None:
    """
    Write P C', and the variances of the innovations over that of the noise (D 27).

    Of the members that move; the others keep their variances.
    """
    d, correlation, used = n + 1 + k, members.rates[CORRELATION], members.noise[USED]
    for g in range(moving, COUNT):
        s[g] = members.record[VARIANCE, k, g]
    # z_1 of the sample before is the state of now, h back
    third, curve = min(2, d - 1), -0.5 * h * h if d > 2 else 0.0
    for i in range(d):
        row, one, two = gain[i], p[at(d, 0, i)], p[at(d, min(i, 1), max(i, 1))]
        three = p[at(d, min(i, third), max(i, third))]
        for g in range(moving):
            before = one[g] - h * two[g] - curve * three[g]
            row[g] = one[g] - correlation[g] * before
    one, two, three = gain[0], gain[1], gain[third]
    for g in range(moving):
        before = one[g] - h * two[g] - curve * three[g]
        s[g] = one[g] - correlation[g] * before
    for g in range(moving):
        s[g] = INEXACT * (1.0 + max(s[g], 0.0) / used[COLOUR[g]])


@compiled(fastmath=FAST)
def allow_jump(
    members: Members,
    scratch: Scratch,
    n: int,
    k: int,
    y: float,
    tau: float,
    p: Floats,
    gain: Floats,
) -> None:
    """
    Let the members believe that d has jumped: raise P as far as the sample asks for it (D 33).

    What the noise was before does not count, so that coloured noise begins afresh. Innovations,
    their variances, `p` and `gain` are replaced.

    Parameters
    ----------
    tau : float
        Time since the jump; 0 for the samples that follow, for which P knows what is uncertain.

    """
    used, more, d = scratch.lines[0], scratch.lines[1], n + 1 + k
    b, s, first, a = scratch.b[k], scratch.s[k], scratch.x[k][0], members.rates[CORRELATION]
    fill(used, members.noise[USED])
    for g in range(COUNT):
        b[g] = y - first[g]
        variance, square = p[0, g] + used[g] / (1.0 - a[g] * a[g]), b[g] * b[g]
        more[g] = square - variance if square > HUBER * HUBER * variance else 0.0
        s[g] = INEXACT * (variance + more[g]) / used[g]
    if tau == 0.0:
        for g in range(COUNT):
            more[g] = 1.0 + more[g] / p[0, g]
        for row in p:
            for g in range(COUNT):
                row[g] *= more[g]
    for i in range(n + 1 if tau > 0.0 else 0):  # at its begin, or at any time of it
        for j in range(i, n + 1):
            share = FACTORIALS[n] / FACTORIALS[n - i] * FACTORIALS[n] / FACTORIALS[n - j]
            share *= 0.5 + 0.5 * (2.0 * n + 1.0) / (2.0 * n + 1.0 - i - j)
            add_scaled(p[at(d, i, j)], share / tau ** (i + j), more, COUNT)
    for i in range(d):
        gain[i, :] = p[at(d, 0, i)]


@compiled(fastmath=FAST)
def correct_covariances(
    members: Members,
    n: int,
    k: int,
    p: Floats,
    gain: Floats,
    lines: Floats,
    moving: int,
) -> None:
    """
    Take a sample into P of the members that move, and turn P C' into their gains (D 27).

    By factors for each member in `lines`: gains are P C' times the first of them, and P loses
    P C' C P times the third.
    """
    d, inverse, scaled, taken = n + 1 + k, lines[0], lines[1], lines[2]
    corrected, gains = members.p[k], members.gain[k]
    for i in range(d):
        first, row = gain[i], gains[i]
        for g in range(moving):
            scaled[g] = first[g] * taken[g]
        for j in range(i, d):
            second, before, after = gain[j], p[at(d, i, j)], corrected[at(d, i, j)]
            for g in range(moving):
                after[g] = before[g] - scaled[g] * second[g]
        for g in range(moving):
            row[g] = first[g] * inverse[g]


@compiled(fastmath=FAST)
def correct_states(members: Members, scratch: Scratch, n: int, y: float) -> None:
    """Correct the members' predictions by their innovations, of bounded influence."""
    correlation, limit = members.rates[CORRELATION], scratch.lines[0]
    for g in range(IN_BAND):
        square = members.noise[SQUARE, COLOUR[g]]
        limit[g] = HUBER * math.sqrt(square / (1.0 - correlation[g] * correlation[g]))
    repeat(limit)
    for k in range(ORDERS):
        x, predicted, gain = members.x[k], scratch.x[k], members.gain[k]
        innovation = scratch.b[k]
        for i in range(n + 1 + k):
            row, source, factor = x[i], predicted[i], gain[i]
            for g in range(COUNT):
                row[g] = source[g] + factor[g] * innovation[g]
        residual, first = members.record[RESIDUAL, k], x[0]
        for g in range(COUNT):
            residual[g] = min(max(y - first[g], -limit[g]), limit[g])
