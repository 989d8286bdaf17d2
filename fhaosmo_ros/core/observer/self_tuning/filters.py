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
    INTENSITY,
    KAPPA,
    Members,
    ORDERS,
    RESIDUAL,
    SQUARE,
    USED,
    VARIANCE,
)
import numpy as np

HUBER = 3.0
"""Innovations of more standard deviations count as so many (Huber 1964)."""


@compiled(forceinline=True)
def at(d: int, i: int, j: int) -> int:
    """Return the row of P_ij, i <= j, in an upper triangle of d rows."""
    return i * d - i * (i - 1) // 2 + j - i


@compiled()
def predict_states(
    members: Members, n: int, k: int, h: float, mean: Floats, predicted: Floats, x: Floats
) -> None:
    """Predict the members' estimates: the mean's path, plus the flow of their deviations."""
    flow, kappa, decayed = members.flow, members.rates[KAPPA], members.rates[DECAYED]
    ahead = np.empty((n, COUNT))
    for i in range(n):
        base = predicted[i]
        for j in range(n + ORDERS):
            base -= flow[i, j] * mean[j]
        row = ahead[i]
        f0, f1, f2, d = flow[i, n], flow[i, n + 1], flow[i, n + 2], x[n]
        for g in range(COUNT):
            c = kappa[g]
            row[g] = base + (f0 - c * (f1 - c * f2)) * d[g]
        if k > 0:
            rate = x[n + 1]
            for g in range(COUNT):
                row[g] += (f1 - 2.0 * kappa[g] * f2) * rate[g]
        if k > 1:
            second = x[n + 2]
            for g in range(COUNT):
                row[g] += f2 * second[g]
        for j in range(n):
            s, other = flow[i, j], x[j]
            if s != 0.0:
                for g in range(COUNT):
                    row[g] += s * other[g]
    for i in range(n):
        row, target = ahead[i], x[i]
        for g in range(COUNT):
            target[g] = row[g]
    for i in range(k + 1):  # exp of D 17: e^(-kappa h) times a polynomial
        target = x[n + i]
        for g in range(COUNT):
            target[g] *= decayed[g]
        for j in range(i + 1, k + 1):
            factor, other = h ** (j - i) / FACTORIALS[j - i], x[n + j]
            for g in range(COUNT):
                target[g] += decayed[g] * factor * other[g]


@compiled()
def predict_covariances(
    members: Members, n: int, k: int, h: float, p: Floats, moving: int
) -> None:
    """P <- A P A' + Q of the members that move (D 27)."""
    flow, kappa, decayed = members.flow, members.rates[KAPPA], members.rates[DECAYED]
    intensity, d = members.record[INTENSITY, k], n + 1 + k
    product, chain = np.empty((d, d, moving)), np.empty((n, k + 1, moving))
    for i in range(n):
        f0, f1, f2 = flow[i, n], flow[i, n + 1], flow[i, n + 2]
        for g in range(moving):
            c = kappa[g]
            chain[i, 0, g] = f0 - c * (f1 - c * f2)
            if k > 0:
                chain[i, 1, g] = f1 - 2.0 * c * f2
            if k > 1:
                chain[i, 2, g] = f2
    for j in range(d):  # A P
        for i in range(n):
            row = product[i, j]
            for g in range(moving):
                row[g] = 0.0
            for m in range(n):
                s, other = flow[i, m], p[at(d, min(j, m), max(j, m))]
                if s != 0.0:
                    for g in range(moving):
                        row[g] += s * other[g]
            for m in range(k + 1):
                part, other = chain[i, m], p[at(d, min(j, n + m), max(j, n + m))]
                for g in range(moving):
                    row[g] += part[g] * other[g]
        for i in range(k + 1):
            row = product[n + i, j]
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
            row = p[at(d, i, j)]
            for g in range(moving):
                row[g] = share * intensity[g]
            if j < n:
                for m in range(n):
                    s, other = flow[j, m], product[i, m]
                    if s != 0.0:
                        for g in range(moving):
                            row[g] += s * other[g]
                for m in range(k + 1):
                    part, other = chain[j, m], product[i, n + m]
                    for g in range(moving):
                        row[g] += part[g] * other[g]
            else:
                for m in range(j, d):
                    factor, other = h ** (m - j) / FACTORIALS[m - j], product[i, m]
                    for g in range(moving):
                        row[g] += decayed[g] * factor * other[g]


@compiled()
def expect_innovations(
    members: Members, n: int, k: int, h: float, p: Floats, gain: Floats, s: Floats, moving: int
) -> None:
    """Write P C', and the variances of the innovations over that of the noise (D 27)."""
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


@compiled()
def correct_covariances(
    members: Members, n: int, k: int, p: Floats, gain: Floats, s: Floats, moving: int
) -> None:
    """Take a sample into P of the members that move, and turn P C' into their gains (D 27)."""
    d, used, inverse = n + 1 + k, members.noise[USED], np.empty(moving)
    for g in range(moving):
        inverse[g] = 1.0 / (s[g] * used[COLOUR[g]])
    for i in range(d):
        first = gain[i]
        for j in range(i, d):
            second, row = gain[j], p[at(d, i, j)]
            for g in range(moving):
                row[g] -= first[g] * second[g] * inverse[g]
    for i in range(d):
        row = gain[i]
        for g in range(moving):
            row[g] *= inverse[g]


@compiled()
def correct_states(members: Members, n: int, k: int, y: float, ahead: Floats, b: Floats) -> None:
    """Correct the members' predictions by their innovations `b`, of bounded influence."""
    x, gain = members.x[k], members.gain[k]
    for i in range(n + 1 + k):
        row, source, factor = x[i], ahead[i], gain[i]
        for g in range(COUNT):
            row[g] = source[g] + factor[g] * b[g]
    residual, correlation = members.record[RESIDUAL, k], members.rates[CORRELATION]
    for g in range(COUNT):
        c = correlation[g]
        limit = HUBER * math.sqrt(members.noise[SQUARE, COLOUR[g]] / (1.0 - c * c))
        residual[g] = min(max(y - x[0, g], -limit), limit)
