# SPDX-License-Identifier: Apache-2.0
"""
The covariances of the members: prediction and correction (D 27).

Only those of a range of columns, which move; the others rest at their steady values. What d and
its three derivatives have is written out, so that a loop does all of it for a member.
"""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.self_tuning.members import (
    CORRELATION,
    COUNT,
    DECAYED,
    FAST,
    fill,
    grid,
    KAPPA,
    Members,
    ORDERS,
    Scratch,
    USED,
)

OF_DRIVE = ORDERS * (ORDERS + 1) // 2
"""Covariances of d and its derivatives: the last rows of P."""
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


@compiled(forceinline=True)
def neighbours(rows: Floats, first: int, count: int) -> Floats:
    """
    Return `count` rows of COUNT numbers from row `first` on.

    The compiler knows how far apart they are then, and does not ask at each start of a loop
    whether what it writes may be what it reads.
    """
    return grid(rows.ctypes.data, first * COUNT, count)


@compiled(forceinline=True)
def by_derivatives(h: float) -> tuple[float, float, float]:
    """Return what the levels behind d, or a derivative of it, do to it (D 17), but for decay."""
    return h, h * h / 2.0, h * h * h / 6.0


@compiled(fastmath=FAST)
def predict_drive(
    members: Members, scratch: Scratch, n: int, h: float, first: int, last: int
) -> None:
    """Predict the covariances of d and its derivatives."""
    d, (a, b, c), decayed = at(n + ORDERS, n, n), by_derivatives(h), members.rates[DECAYED]
    p, q = neighbours(members.p, d, OF_DRIVE), neighbours(scratch.q, d, OF_DRIVE)
    after = neighbours(scratch.p, d, OF_DRIVE)
    for g in range(first, last):
        p11, p12, p13, p22, p23, p33 = p[4, g], p[5, g], p[6, g], p[7, g], p[8, g], p[9, g]
        twice = decayed[g] * decayed[g]
        one, two, three = p11 + a * p12 + b * p13, p12 + a * p22 + b * p23, p13 + a * p23 + b * p33
        third = p[3, g] + a * p13 + b * p23 + c * p33
        second = p[2, g] + a * p12 + b * p22 + c * p23
        slope = p[1, g] + a * p11 + b * p12 + c * p13
        none = p[0, g] + a * p[1, g] + b * p[2, g] + c * p[3, g]
        after[0, g] = q[0, g] + twice * (none + a * slope + b * second + c * third)
        after[1, g] = q[1, g] + twice * (slope + a * second + b * third)
        after[2, g] = q[2, g] + twice * (second + a * third)
        after[3, g] = q[3, g] + twice * third
        after[4, g] = q[4, g] + twice * (one + a * two + b * three)
        after[5, g] = q[5, g] + twice * (two + a * three)
        after[6, g] = q[6, g] + twice * three
        after[7, g] = q[7, g] + twice * (p22 + a * p23 + a * (p23 + a * p33))
        after[8, g] = q[8, g] + twice * (p23 + a * p33)
        after[9, g] = q[9, g] + twice * p33


@compiled(fastmath=FAST)
def multiply(members: Members, scratch: Scratch, n: int, i: int, first: int, last: int) -> None:
    """Write row i of A P, of a state z_i, and what d and its derivatives do to it."""
    d, flow, kappa, rows = n + ORDERS, members.flow, members.rates[KAPPA], members.p
    p, product = (
        neighbours(rows, at(d, n, n), OF_DRIVE),
        neighbours(scratch.product, i * d + n, ORDERS),
    )
    chain = neighbours(scratch.chain, 3 * i, 3)
    f0, f1, f2, f3 = by_chain(flow, i, n)
    for g in range(first, last):
        c = kappa[g]
        chain[0, g] = f0 - c * (f1 - c * (f2 - c * f3))
        chain[1, g] = f1 - c * (2.0 * f2 - 3.0 * c * f3)
        chain[2, g] = f2 - 3.0 * c * f3
    for g in range(first, last):
        by_d, slope, second = chain[0, g], chain[1, g], chain[2, g]
        product[0, g] = by_d * p[0, g] + slope * p[1, g] + second * p[2, g] + f3 * p[3, g]
        product[1, g] = by_d * p[1, g] + slope * p[4, g] + second * p[5, g] + f3 * p[6, g]
        product[2, g] = by_d * p[2, g] + slope * p[5, g] + second * p[7, g] + f3 * p[8, g]
        product[3, g] = by_d * p[3, g] + slope * p[6, g] + second * p[8, g] + f3 * p[9, g]
    for m in range(0, n, 3):
        a, b, c, e, f = by_model(flow, i, m, n)
        if a != 0.0 or b != 0.0 or c != 0.0:
            one, two = neighbours(rows, at(d, m, n), ORDERS), neighbours(rows, at(d, e, n), ORDERS)
            three = neighbours(rows, at(d, f, n), ORDERS)
            for g in range(first, last):
                product[0, g] += a * one[0, g] + b * two[0, g] + c * three[0, g]
                product[1, g] += a * one[1, g] + b * two[1, g] + c * three[1, g]
                product[2, g] += a * one[2, g] + b * two[2, g] + c * three[2, g]
                product[3, g] += a * one[3, g] + b * two[3, g] + c * three[3, g]
    for j in range(n):
        row, cross = scratch.product[i * d + j], neighbours(rows, at(d, j, n), ORDERS)
        for g in range(first, last):
            more = chain[0, g] * cross[0, g] + chain[1, g] * cross[1, g]
            row[g] = more + chain[2, g] * cross[2, g] + f3 * cross[3, g]
        for m in range(0, n, 3):
            a, b, c, e, f = by_model(flow, i, m, n)
            one, two, three = rows[at(d, j, m)], rows[at(d, j, e)], rows[at(d, j, f)]
            add_three(row, a, one, b, two, c, three, first, last)


@compiled(fastmath=FAST)
def predict_covariances(
    members: Members, scratch: Scratch, n: int, h: float, first: int, last: int
) -> None:
    """Write A P A' + Q of the columns `first` .. `last` - 1 (D 27)."""
    integrate_drive(members, scratch, n, h, first, last)
    predict_drive(members, scratch, n, h, first, last)
    for i in range(n):
        multiply(members, scratch, n, i, first, last)
    (a, b, c), decayed, flow, d = (
        by_derivatives(h), members.rates[DECAYED], members.flow, n + ORDERS
    )  # fmt: skip
    for i in range(n):
        product, q = (
            neighbours(scratch.product, i * d + n, ORDERS),
            neighbours(scratch.q, at(d, i, n), ORDERS),
        )
        after = neighbours(scratch.p, at(d, i, n), ORDERS)
        for g in range(first, last):
            slope, second, third = product[1, g], product[2, g], product[3, g]
            none = product[0, g] + a * slope + b * second + c * third
            after[0, g] = q[0, g] + decayed[g] * none
            after[1, g] = q[1, g] + decayed[g] * (slope + a * second + b * third)
            after[2, g] = q[2, g] + decayed[g] * (second + a * third)
            after[3, g] = q[3, g] + decayed[g] * third
        for j in range(i, n):
            row, added, chain = (
                scratch.p[at(d, i, j)], scratch.q[at(d, i, j)], neighbours(scratch.chain, 3 * j, 3)
            )  # fmt: skip
            f3 = flow[j, n + 3]
            for g in range(first, last):
                more = chain[0, g] * product[0, g] + chain[1, g] * product[1, g]
                row[g] = added[g] + more + chain[2, g] * product[2, g] + f3 * product[3, g]
            for m in range(0, n, 3):
                e_a, e_b, e_c, e, f = by_model(flow, j, m, n)
                one, two, three = (
                    scratch.product[i * d + m], scratch.product[i * d + e],
                    scratch.product[i * d + f],
                )  # fmt: skip
                add_three(row, e_a, one, e_b, two, e_c, three, first, last)


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
def correct_covariances(members: Members, scratch: Scratch, n: int, first: int, last: int) -> None:
    """
    Take a sample into P of the columns `first` .. `last` - 1, and turn P C' into gains (D 27).

    By factors for each member in lines 0 and 2 of the scratch: gains are P C' times the first of
    them, and P loses P C' C P times the other.
    """
    inverse, taken, d = scratch.lines[0], scratch.lines[2], n + ORDERS
    of_drive = neighbours(scratch.gain, n, ORDERS)
    for i in range(d):
        one, row = scratch.gain[i], members.gain[i]
        for g in range(first, last):
            row[g] = one[g] * inverse[g]
    for i in range(n):
        one = scratch.gain[i]
        for j in range(i, n):
            two, before, after = scratch.gain[j], scratch.p[at(d, i, j)], members.p[at(d, i, j)]
            for g in range(first, last):
                after[g] = before[g] - taken[g] * one[g] * two[g]
        four, left = (
            neighbours(scratch.p, at(d, i, n), ORDERS),
            neighbours(members.p, at(d, i, n), ORDERS),
        )
        for g in range(first, last):
            scaled = taken[g] * one[g]
            left[0, g] = four[0, g] - scaled * of_drive[0, g]
            left[1, g] = four[1, g] - scaled * of_drive[1, g]
            left[2, g] = four[2, g] - scaled * of_drive[2, g]
            left[3, g] = four[3, g] - scaled * of_drive[3, g]
    p, corrected = (
        neighbours(scratch.p, at(d, n, n), OF_DRIVE),
        neighbours(members.p, at(d, n, n), OF_DRIVE),
    )
    for g in range(first, last):
        none, slope, second = of_drive[0, g], of_drive[1, g], of_drive[2, g]
        third, scaled = of_drive[3, g], taken[g] * none
        corrected[0, g] = p[0, g] - scaled * none
        corrected[1, g] = p[1, g] - scaled * slope
        corrected[2, g] = p[2, g] - scaled * second
        corrected[3, g] = p[3, g] - scaled * third
        scaled = taken[g] * slope
        corrected[4, g] = p[4, g] - scaled * slope
        corrected[5, g] = p[5, g] - scaled * second
        corrected[6, g] = p[6, g] - scaled * third
        scaled = taken[g] * second
        corrected[7, g] = p[7, g] - scaled * second
        corrected[8, g] = p[8, g] - scaled * third
        corrected[9, g] = p[9, g] - taken[g] * third * third
