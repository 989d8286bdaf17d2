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
    INTENSITY,
    KAPPA,
    Members,
    ORDERS,
    RESIDUAL,
    Scratch,
    SQUARE,
    USED,
    VARIANCE,
)

HUBER = 3.0
"""Innovations of more standard deviations count as so many (Huber 1964)."""


@compiled(forceinline=True)
def at(d: int, i: int, j: int) -> int:
    """Return the row of P_ij, i <= j, in an upper triangle of d rows."""
    return i * d - i * (i - 1) // 2 + j - i


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
            s, other = flow[i, j], x[j]
            if s != 0.0:
                for g in range(COUNT):
                    row[g] += s * other[g]
    for i in range(k + 1):  # exp of D 17: e^(-kappa h) times a polynomial
        row, other = ahead[n + i], x[n + i]
        for g in range(COUNT):
            row[g] = decayed[g] * other[g]
        for j in range(i + 1, k + 1):
            factor, other = h ** (j - i) / FACTORIALS[j - i], x[n + j]
            for g in range(COUNT):
                row[g] += decayed[g] * factor * other[g]


@compiled(fastmath=FAST)
def predict_covariances(
    members: Members, n: int, k: int, h: float, ahead: Floats, rest: Floats, moving: int
) -> None:
    """Write A P A' + Q of the members that move (D 27) to `ahead`."""
    p, flow = members.p[k], members.flow
    kappa, decayed = members.rates[KAPPA], members.rates[DECAYED]
    intensity, d = members.record[INTENSITY, k], n + 1 + k
    product = grid(rest, 0, d * d, moving)  # A P
    chain = grid(rest, d * d * moving, n * (k + 1), moving)
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
    for j in range(d):
        for i in range(n):
            row = product[i * d + j]
            for g in range(moving):
                row[g] = 0.0
            for m in range(n):
                s, other = flow[i, m], p[at(d, min(j, m), max(j, m))]
                if s != 0.0:
                    for g in range(moving):
                        row[g] += s * other[g]
            for m in range(k + 1):
                part, other = chain[i * (k + 1) + m], p[at(d, min(j, n + m), max(j, n + m))]
                for g in range(moving):
                    row[g] += part[g] * other[g]
        for i in range(k + 1):
            row = product[(n + i) * d + j]
            for g in range(moving):
                row[g] = 0.0
            for m in range(i, k + 1):
                other = p[at(d, min(j, n + m), max(j, n + m))]
                factor = h ** (m - i) / FACTORIALS[m - i]
                for g in range(moving):
                    row[g] += decayed[g] * factor * other[g]
    for i in range(d):  # .. A' + Q, Q as in D 20
        for j in range(i, d):
            below = 2 * d - 2 - i - j
            share = h ** (below + 1) / (below + 1)
            share /= FACTORIALS[d - 1 - i] * FACTORIALS[d - 1 - j]
            row = ahead[at(d, i, j)]
            for g in range(moving):
                row[g] = share * intensity[g]
            if j < n:
                for m in range(n):
                    s, other = flow[j, m], product[i * d + m]
                    if s != 0.0:
                        for g in range(moving):
                            row[g] += s * other[g]
                for m in range(k + 1):
                    part, other = chain[j * (k + 1) + m], product[i * d + n + m]
                    for g in range(moving):
                        row[g] += part[g] * other[g]
            else:
                for m in range(j, d):
                    factor, other = h ** (m - j) / FACTORIALS[m - j], product[i * d + m]
                    for g in range(moving):
                        row[g] += decayed[g] * factor * other[g]


@compiled(fastmath=FAST)
def expect_innovations(
    members: Members, n: int, k: int, h: float, p: Floats, gain: Floats, s: Floats, moving: int
) -> None:
    """
    Write P C', and the variances of the innovations over that of the noise (D 27).

    Of the members that move; the others keep their variances.
    """
    d, correlation = n + 1 + k, members.rates[CORRELATION]
    used, top = members.noise[USED], min(3, n + 1 + k)
    for g in range(moving, COUNT):
        s[g] = members.record[VARIANCE, k, g]
    for i in range(d):
        row, other = gain[i], p[at(d, 0, i)]
        for g in range(moving):
            row[g] = (1.0 - correlation[g]) * other[g]
        for j in range(1, top):  # z_1 of the sample before is the state of now, h back
            other, factor = p[at(d, min(i, j), max(i, j))], -((-h) ** j) / FACTORIALS[j]
            for g in range(moving):
                row[g] += correlation[g] * factor * other[g]
    first = gain[0]
    for g in range(moving):
        s[g] = (1.0 - correlation[g]) * first[g]
    for j in range(1, top):
        row, factor = gain[j], -((-h) ** j) / FACTORIALS[j]
        for g in range(moving):
            s[g] += correlation[g] * factor * row[g]
    for g in range(moving):
        s[g] = 1.0 + max(s[g], 0.0) / used[COLOUR[g]]


@compiled(fastmath=FAST)
def correct_covariances(
    members: Members,
    n: int,
    k: int,
    p: Floats,
    gain: Floats,
    s: Floats,
    lines: Floats,
    moving: int,
) -> None:
    """Take a sample into P of the members that move, and turn P C' into their gains (D 27)."""
    d, used, inverse, scaled = n + 1 + k, members.noise[USED], lines[0], lines[1]
    for g in range(moving):
        inverse[g] = 1.0 / (s[g] * used[COLOUR[g]])
    for i in range(d):
        first, corrected = gain[i], members.gain[k][i]
        for g in range(moving):
            scaled[g] = first[g] * inverse[g]
        for j in range(i, d):
            second, row, target = gain[j], p[at(d, i, j)], members.p[k][at(d, i, j)]
            for g in range(moving):
                target[g] = row[g] - scaled[g] * second[g]
        for g in range(moving):
            corrected[g] = scaled[g]


@compiled(fastmath=FAST)
def correct_states(members: Members, scratch: Scratch, n: int, y: float) -> None:
    """Correct the members' predictions by their innovations, of bounded influence."""
    correlation, limit = members.rates[CORRELATION], scratch.lines[0]
    fill(limit, members.noise[SQUARE])
    for g in range(COUNT):
        limit[g] = HUBER * math.sqrt(limit[g] / (1.0 - correlation[g] * correlation[g]))
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
