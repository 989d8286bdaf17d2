# SPDX-License-Identifier: Apache-2.0
"""The members as filters: prediction and correction of estimates, and jumps of d (D 27, D 33)."""

import math
from typing import Any

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.self_tuning.covariances import (
    add_three,
    at,
    by_chain,
    by_derivatives,
    by_model,
    correct_covariances,
    expect_innovations,
    INEXACT,
    neighbours,
    predict_covariances,
)
from fhaosmo_ros.core.observer.self_tuning.members import (
    COLOURS,
    CORRELATION,
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
    (a, b, c), now, after = (
        by_derivatives(h),
        neighbours(x, n, ORDERS),
        neighbours(ahead, n, ORDERS),
    )
    for g in range(members.active):
        slope, second, third = now[1, g], now[2, g], now[3, g]
        after[0, g] = decayed[g] * (now[0, g] + a * slope + b * second + c * third)
        after[1, g] = decayed[g] * (slope + a * second + b * third)
        after[2, g] = decayed[g] * (second + a * third)
        after[3, g] = decayed[g] * third


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
