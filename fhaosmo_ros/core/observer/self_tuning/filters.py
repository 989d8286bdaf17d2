# SPDX-License-Identifier: Apache-2.0
"""The members as filters: prediction and correction of estimates and covariances (D 27)."""

import math
from typing import Any

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.self_tuning.members import (
    COLOURS,
    CORRELATION,
    COUNT,
    DECAYED,
    FACTORIALS,
    FAST,
    fill,
    FIRST,
    HALF,
    KAPPA,
    LOG_VARIANCE,
    Members,
    ORDERS,
    RESIDUAL,
    Scratch,
    SQUARE,
    USED,
    VARIANCE,
)
import numpy as np

HUBER = 3.0
"""Innovations of more standard deviations count as so many (Huber 1964)."""
INEXACT = 1.0 + 1e-10
"""
By this factor S is too large, so that P stays positive where y is by many orders of magnitude more
exact than its prediction: what is left of P then is more than what rounding makes of it.
"""


@compiled(forceinline=True)
def at(d: int, i: int, j: int) -> int:
    """Return the row of P_ij in an upper triangle of d rows."""
    low, high = min(i, j), max(i, j)
    return low * d - low * (low - 1) // 2 + high - low


@compiled(forceinline=True)
def by_chain(flow: Floats, i: int, n: int) -> tuple[float, float, float, float]:
    """Return what d and its derivatives do to z_i."""
    return flow[i, n], flow[i, n + 1], flow[i, n + 2], flow[i, n + 3]


@compiled(forceinline=True)
def decaying(h: float, i: int, d: int) -> tuple[float, float, float, int, int, int]:
    """Return what the levels behind level i do to it (D 17), but for its decay; and which."""
    a, b, c = min(i + 1, d - 1), min(i + 2, d - 1), min(i + 3, d - 1)
    return (
        h if i + 1 < d else 0.0,
        h * h / 2.0 if i + 2 < d else 0.0,
        h * h * h / 6.0 if i + 3 < d else 0.0,
        a, b, c,
    )  # fmt: skip


@compiled(forceinline=True, fastmath=FAST)
def add_three(
    row: Floats,
    a: float,
    one: Floats,
    b: float,
    two: Floats,
    c: float,
    three: Floats,
    first: int,
    last: int,
) -> None:
    """Add three rows times factors, which are often 0, to the columns `first` .. `last` - 1."""
    if a != 0.0 or b != 0.0 or c != 0.0:
        for g in range(first, last):
            row[g] += a * one[g] + b * two[g] + c * three[g]


@compiled(forceinline=True)
def by_model(flow: Floats, i: int, m: int, n: int) -> tuple[float, float, float, int, int]:
    """Return what z_m and the next two do to z_i, 0 beyond z_n; and which those two are."""
    e, f = min(m + 1, n - 1), min(m + 2, n - 1)
    return flow[i, m], flow[i, e] if e > m else 0.0, flow[i, f] if f > m + 1 else 0.0, e, f


@compiled(fastmath=FAST)
def predict_states(
    members: Members, scratch: Scratch, n: int, h: float, mean: Floats, predicted: Floats
) -> None:
    """Predict the members' estimates: the mean's path, plus the flow of their deviations."""
    flow, kappa, decayed = members.flow, members.rates[KAPPA], members.rates[DECAYED]
    x, ahead = members.x, scratch.x
    d, first, second, third = x[n], x[n + 1], x[n + 2], x[n + 3]
    for i in range(n):
        base = predicted[i]
        for j in range(n + ORDERS):
            base -= flow[i, j] * mean[j]
        row = ahead[i]
        f0, f1, f2, f3 = by_chain(flow, i, n)
        for g in range(members.active):
            c = kappa[g]
            by_d, by_first = f0 - c * (f1 - c * (f2 - c * f3)), f1 - c * (2.0 * f2 - 3.0 * c * f3)
            by_second = f2 - 3.0 * c * f3
            row[g] = (
                base + by_d * d[g] + by_first * first[g] + by_second * second[g] + f3 * third[g]
            )
        for m in range(0, n, 3):
            a, b, c, e, f = by_model(flow, i, m, n)
            add_three(row, a, x[m], b, x[e], c, x[f], 0, members.active)
    # exp of D 17: e^(-kappa h) times a polynomial
    for i in range(n, n + ORDERS):
        row, one = ahead[i], x[i]
        a, b, c, at_a, at_b, at_c = decaying(h, i, n + ORDERS)
        two, three, four = x[at_a], x[at_b], x[at_c]
        for g in range(members.active):
            row[g] = decayed[g] * (one[g] + a * two[g] + b * three[g] + c * four[g])


@compiled(fastmath=FAST)
def multiply(members: Members, scratch: Scratch, n: int, h: float, first: int, last: int) -> None:
    """Write A P of the columns `first` .. `last` - 1, as far as A P A' needs it."""
    p, flow, product, chain = members.p, members.flow, scratch.product, scratch.chain
    kappa, decayed, d = members.rates[KAPPA], members.rates[DECAYED], n + ORDERS
    lowest = d
    for i in range(d - 1, -1, -1):  # A has zeros below its diagonal, most of them
        lowest = min(lowest, i)
        for m in range(i if i < n else 0):
            if flow[i, m] != 0.0:
                lowest = min(lowest, m)
        if i >= n:
            a, b, c, at_a, at_b, at_c = decaying(h, i, d)
            for j in range(lowest, d):
                row, one, two = product[i * d + j], p[at(d, j, i)], p[at(d, j, at_a)]
                three, four = p[at(d, j, at_b)], p[at(d, j, at_c)]
                for g in range(first, last):
                    row[g] = decayed[g] * (one[g] + a * two[g] + b * three[g] + c * four[g])
            continue
        f0, f1, f2, f3 = by_chain(flow, i, n)
        by_d, by_first, by_second = chain[3 * i], chain[3 * i + 1], chain[3 * i + 2]
        for g in range(first, last):
            c = kappa[g]
            by_d[g] = f0 - c * (f1 - c * (f2 - c * f3))
            by_first[g] = f1 - c * (2.0 * f2 - 3.0 * c * f3)
            by_second[g] = f2 - 3.0 * c * f3
        for j in range(lowest, d):
            row = product[i * d + j]
            one, two = p[at(d, j, n)], p[at(d, j, n + 1)]
            three, four = p[at(d, j, n + 2)], p[at(d, j, n + 3)]
            for g in range(first, last):
                more = by_d[g] * one[g] + by_first[g] * two[g]
                row[g] = more + by_second[g] * three[g] + f3 * four[g]
            for m in range(0, n, 3):
                a, b, c, e, f = by_model(flow, i, m, n)
                one, two, three = p[at(d, j, m)], p[at(d, j, e)], p[at(d, j, f)]
                add_three(row, a, one, b, two, c, three, first, last)


@compiled(forceinline=True)
def share(powers: Floats, h: float, a: int, b: int) -> float:
    """Return the integral of t^(a + b) / (a! b!) over h: what q adds to a covariance (D 20)."""
    return powers[a] * powers[b] * h / (a + b + 1) if a >= 0 and b >= 0 else 0.0


@compiled(fastmath=FAST)
def integrate_drive(
    members: Members, scratch: Scratch, n: int, h: float, first: int, last: int
) -> None:
    """Write Q of the columns `first` .. `last` - 1 (D 27), unless it is there already."""
    drive, holds, d, powers = members.drive, scratch.holds, n + ORDERS, scratch.lines[0]
    none, slope, curve, jerk = drive[0], drive[1], drive[2], drive[3]
    one, other = none[0], jerk[COUNT - 1]  # all others follow from these two (D 26)
    there = holds[0] == h and holds[1] == one and holds[2] == other
    if there and holds[3] <= first and last <= holds[4]:
        return
    holds[0], holds[1], holds[2], holds[3], holds[4] = h, one, other, first, last
    powers[0] = 1.0  # h^j / j!
    for i in range(1, d):
        powers[i] = powers[i - 1] * h / i
    for i in range(d):
        for j in range(i, d):
            row = scratch.q[at(d, i, j)]
            q0 = share(powers, h, n - i, n - j)
            q1 = share(powers, h, n + 1 - i, n + 1 - j)
            q2 = share(powers, h, n + 2 - i, n + 2 - j)
            q3 = share(powers, h, n + 3 - i, n + 3 - j)
            for g in range(first, last):
                row[g] = q0 * none[g] + q1 * slope[g] + q2 * curve[g] + q3 * jerk[g]


@compiled(fastmath=FAST)
def predict_covariances(
    members: Members, scratch: Scratch, n: int, h: float, first: int, last: int
) -> None:
    """Write A P A' + Q of the columns `first` .. `last` - 1 (D 27)."""
    multiply(members, scratch, n, h, first, last)
    integrate_drive(members, scratch, n, h, first, last)
    product, chain, flow = scratch.product, scratch.chain, members.flow
    decayed, d = members.rates[DECAYED], n + ORDERS
    for i in range(d):
        for j in range(i, d):
            row, q = scratch.p[at(d, i, j)], scratch.q[at(d, i, j)]
            if j >= n:
                a, b, c, at_a, at_b, at_c = decaying(h, j, d)
                one, two = product[i * d + j], product[i * d + at_a]
                three, four = product[i * d + at_b], product[i * d + at_c]
                for g in range(first, last):
                    row[g] = q[g] + decayed[g] * (one[g] + a * two[g] + b * three[g] + c * four[g])
                continue
            by_d, by_first, by_second = chain[3 * j], chain[3 * j + 1], chain[3 * j + 2]
            f3, at_d = flow[j, n + 3], i * d + n
            one, two = product[at_d], product[at_d + 1]
            three, four = product[at_d + 2], product[at_d + 3]
            for g in range(first, last):
                more = by_d[g] * one[g] + by_first[g] * two[g]
                row[g] = q[g] + more + by_second[g] * three[g] + f3 * four[g]
            for m in range(0, n, 3):
                a, b, c, e, f = by_model(flow, j, m, n)
                one, two, three = product[i * d + m], product[i * d + e], product[i * d + f]
                add_three(row, a, one, b, two, c, three, first, last)


@compiled(fastmath=FAST)
def expect_innovations(
    members: Members, scratch: Scratch, n: int, h: float, first: int, last: int
) -> None:
    """Write P C', and variances of the innovations over that of the noise, of columns (D 27)."""
    d, correlation, used = n + ORDERS, members.rates[CORRELATION], scratch.lines[0]
    p, gain, s = scratch.p, scratch.gain, scratch.s
    fill(used, members.noise[USED])
    half = 0.5 * h * h
    for i in range(d):  # z_1 of the sample before is the state of now, h back
        row, one, two, three = gain[i], p[at(d, 0, i)], p[at(d, 1, i)], p[at(d, 2, i)]
        for g in range(first, last):
            before = one[g] - h * two[g] + half * three[g]
            row[g] = one[g] - correlation[g] * before
    one, two, three = gain[0], gain[1], gain[2]
    for g in range(first, last):
        before = one[g] - h * two[g] + half * three[g]
        s[g] = INEXACT * (1.0 + max(one[g] - correlation[g] * before, 0.0) / used[g])


@compiled(fastmath=FAST)
def allow_jump(members: Members, scratch: Scratch, n: int, y: float, tau: float) -> None:
    """
    Let the members believe that d has jumped: raise P as far as the sample asks for it (D 33).

    What the noise was before does not count, so that coloured noise begins afresh. Innovations,
    their variances, and the predicted P and P C' are replaced.

    Parameters
    ----------
    tau : float
        Time since the jump; 0 for the samples that follow, for which P knows what is uncertain.

    """
    used, more, d = scratch.lines[0], scratch.lines[1], n + ORDERS
    b, s, p, first, a = scratch.b, scratch.s, scratch.p, scratch.x[0], members.rates[CORRELATION]
    fill(used, members.noise[USED])
    for g in range(members.active):
        b[g] = y - first[g]
        variance, square = p[0, g] + used[g] / (1.0 - a[g] * a[g]), b[g] * b[g]
        more[g] = square - variance if square > HUBER * HUBER * variance else 0.0
        s[g] = INEXACT * (variance + more[g]) / used[g]
    if tau == 0.0:
        for g in range(members.active):
            more[g] = 1.0 + more[g] / p[0, g]
        for row in p:
            for g in range(members.active):
                row[g] *= more[g]
    for i in range(n + 1 if tau > 0.0 else 0):  # at its begin, or at any time of it
        for j in range(i, n + 1):
            part = FACTORIALS[n] / FACTORIALS[n - i] * FACTORIALS[n] / FACTORIALS[n - j]
            part *= 0.5 + 0.5 * (2.0 * n + 1.0) / (2.0 * n + 1.0 - i - j)
            row = p[at(d, i, j)]
            for g in range(members.active):
                row[g] += part / tau ** (i + j) * more[g]
    for i in range(d):
        scratch.gain[i, :] = p[at(d, 0, i)]


@compiled(fastmath=FAST)
def correct_covariances(members: Members, scratch: Scratch, n: int, first: int, last: int) -> None:
    """
    Take a sample into P of the columns `first` .. `last` - 1, and turn P C' into gains (D 27).

    By factors for each member in lines 0 and 2 of the scratch: gains are P C' times the first of
    them, and P loses P C' C P times the other.
    """
    inverse, scaled, taken, d = scratch.lines[0], scratch.lines[1], scratch.lines[2], n + ORDERS
    for i in range(d):
        one, row = scratch.gain[i], members.gain[i]
        for g in range(first, last):
            scaled[g] = one[g] * taken[g]
            row[g] = one[g] * inverse[g]
        for j in range(i, d):
            two, before, after = scratch.gain[j], scratch.p[at(d, i, j)], members.p[at(d, i, j)]
            for g in range(first, last):
                after[g] = before[g] - scaled[g] * two[g]


@compiled(fastmath=FAST)
def correct_states(members: Members, scratch: Scratch, n: int, y: float) -> None:
    """Correct the members' predictions by their innovations, of bounded influence."""
    limit, limits = scratch.lines[0], scratch.lines[1]
    for c in range(COLOURS.size):
        a = members.rates[CORRELATION, FIRST[c]]
        limits[c] = HUBER * math.sqrt(members.noise[SQUARE, c] / (1.0 - a * a))
    fill(limit, limits)
    x, residual, b = members.x, members.record[RESIDUAL], scratch.b
    for i in range(n + ORDERS):
        row, predicted, gain = x[i], scratch.x[i], members.gain[i]
        for g in range(members.active):
            row[g] = predicted[g] + gain[g] * b[g]
    first = x[0]
    for g in range(members.active):
        residual[g] = min(max(y - first[g], -limit[g]), limit[g])


@compiled(forceinline=True)
def of_moving(members: Members, moving: int) -> tuple[Any, Any]:
    """
    Return the first of the columns that move, and the one behind the last.

    As unsigned numbers: the compiler knows then that they do not count from the end, as -1 would.
    """
    return np.uint64(HALF - moving), np.uint64(min(HALF + moving, members.active))


@compiled(fastmath=FAST)
def expect(members: Members, scratch: Scratch, n: int, h: float, y: float, moving: int) -> None:
    """Write what the members expect of a sample, and by what it is off, to `scratch`."""
    b, s, z, residual = scratch.b, scratch.s, scratch.x[0], members.record[RESIDUAL]
    correlation, variance = members.rates[CORRELATION], members.record[VARIANCE]
    for g in range(members.active):
        b[g] = y - z[g] - correlation[g] * residual[g]
    for g in range(members.active):
        s[g] = variance[g]
    if moving > 0:
        first, last = of_moving(members, moving)
        predict_covariances(members, scratch, n, h, first, last)
        expect_innovations(members, scratch, n, h, first, last)


@compiled(fastmath=FAST)
def correct(members: Members, scratch: Scratch, n: int, moving: int, by_interval: bool) -> None:
    """Take a sample into the covariances that move, by the factors of `take_interval` or not."""
    inverse, used, taken, s = scratch.lines[0], scratch.lines[1], scratch.lines[2], scratch.s
    variance, log_variance = members.record[VARIANCE], members.record[LOG_VARIANCE]
    if moving == 0:
        return
    first, last = of_moving(members, moving)
    for g in range(first, last):
        variance[g] = s[g]
    if not by_interval:
        fill(used, members.noise[USED])
        for g in range(first, last):
            inverse[g] = taken[g] = 1.0 / (s[g] * used[g])
        for g in range(first, last):
            log_variance[g] = math.log(s[g])
    correct_covariances(members, scratch, n, first, last)
