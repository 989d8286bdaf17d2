# SPDX-License-Identifier: Apache-2.0
"""
Levant's arbitrary-order differentiator with the paper's curves and power, all three schemes.

One innovation drives every level: eps = y - z_hat_1. Equations are cited by their numbers in
docs/mathematics.md (D). The rows TILDE of the state mirror the estimates, z_tilde_{i+1} =
z_hat_{i+1}, so that whatever reads a cascade's state reads this one; theta is 0.

Not inlined, unlike the cascade: the machine code of a step stays small where this is not used.
"""

import math

from fhaosmo_ros.core.differences import shares
from fhaosmo_ros.core.flow import flow_in_steps
from fhaosmo_ros.core.law import (
    CORRECTION_PERIOD,
    LAMBDA,
    NEWTON_STEPS,
    NEWTON_TOLERANCE,
    PREDICTING,
    PREDICTION_STEP,
    psi,
    SENSITIVE,
    SIGN,
    TINY,
)  # fmt: skip
from fhaosmo_ros.core.layout import HAT, HAT_SENSITIVITY, TILDE, TILDE_SENSITIVITY
from fhaosmo_ros.core.tape import evaluate, Floats, Ints
from numba import njit

MOST_LEVELS = 16
"""order <= 12, the unknown input, and at most 3 derivatives of it."""
SHARES = shares(MOST_LEVELS)


@njit(cache=True, error_model='numpy', forceinline=True)
def mirror(x: Floats) -> None:
    """Write the internal states that stand for the estimates."""
    last = x.shape[1] - 1
    for i in range(last):
        x[TILDE, i] = x[HAT, i + 1]
        x[TILDE_SENSITIVITY, i] = x[HAT_SENSITIVITY, i + 1]
    x[TILDE, last] = 0.0
    x[TILDE_SENSITIVITY, last] = 0.0


@njit(cache=True, error_model='numpy', forceinline=True)
def injection(
    flags: Ints, gains: Floats, curves: Floats, level: int, a: float, power: float, p: float
) -> tuple[float, float]:
    """Return psi(a) |eps|^p and its slope along a = |eps|, given |eps|^p."""
    if a > 0.0:
        s, slope = psi(flags, gains, curves, level, a)
        return power * s, power * (p * s / a + slope)
    if flags[SIGN] or p > 0.0:
        return 0.0, 0.0
    return 0.0, psi(flags, gains, curves, level, 0.0)[1]


@njit(cache=True, error_model='numpy')
def explicit(
    flags: Ints, gains: Floats, curves: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, gamma: float, y: float, h: float, u: float,
) -> tuple[float, float]:  # fmt: skip
    """
    Forward Euler of D 11, in place.

    Parameters
    ----------
    y : float
        Sample at the interval's beginning.

    Returns
    -------
    (float, float)
        L and dL/dgamma at the interval's beginning.

    """
    n = gains.shape[1]
    m[0, 0], m[1, 0] = y, 0.0
    for i in range(1, n):
        m[0, i], m[1, i] = x[HAT, i], x[HAT_SENSITIVITY, i]
    eps, s = y - x[HAT, 0], -x[HAT_SENSITIVITY, 0]
    a = abs(eps)
    log_a = math.log(a) if a > 0.0 else 0.0
    root_power = a ** (2.0 * gamma / n)
    power, follower, dfollower = 1.0, 0.0, 0.0
    for i in range(n - 1, -1, -1):
        phi, dphi = 0.0, 0.0
        if offsets[i + 1] > offsets[i]:
            phi, dphi = evaluate(tape, offsets[i], offsets[i + 1], m, u, stack)
        dp = 2.0 * (n - 1 - i) / n
        value, slope = injection(flags, gains, curves, i, a, power, gamma * dp)
        hat, dhat = x[HAT, i], x[HAT_SENSITIVITY, i]
        x[HAT, i] += h * (follower + phi + gains[LAMBDA, i] * math.copysign(value, eps))
        if flags[SENSITIVE]:  # D 13
            to_gamma = math.copysign(value, eps) * log_a * dp
            x[HAT_SENSITIVITY, i] += h * (
                dfollower + dphi + gains[LAMBDA, i] * (to_gamma + slope * s)
            )
        follower, dfollower = hat, dhat
        power *= root_power
    mirror(x)
    return eps * eps, 2.0 * eps * s


@njit(cache=True, error_model='numpy', forceinline=True)
def root(
    flags: Ints, gains: Floats, curves: Floats, weights: Floats, b: float, gamma: float
) -> tuple[float, float, float]:
    """
    Solve eps + sum_i h^i lambda_i |eps|^{p_i} s_i = b, s_i in psi_i(eps), for b >= 0 (D 12).

    Newton's method on the logarithms of both sides over that of eps: there a sum of powers is
    convex and nearly straight, at any gamma and over any range. Powers are those of w, as
    |eps|^{p_i} = w^{N-i}, but eps does not come from w, which tells nothing of it as gamma goes
    to 0.

    Parameters
    ----------
    weights : (2, N) array
        h^i lambda_i in row 0.

    Returns
    -------
    (float, float, float)
        eps >= 0, w, and s_N, which is set-valued for sign. The left side increases with eps.

    """
    n = gains.shape[1]
    if b < TINY:
        return 0.0, 0.0, 0.0
    constant = 0.0
    if flags[SIGN]:
        constant = weights[0, n - 1]
        if b <= constant:
            return 0.0, 0.0, b / constant  # sliding: the set-valued sign takes what is needed
    target = b - constant
    q = 2.0 * gamma / n
    x = math.log(target)  # of eps; the other terms only make it less
    low, high = math.log(TINY), x
    for _ in range(NEWTON_STEPS):
        w = math.exp(q * x)
        e = w**n if gamma == 0.5 else math.exp(x)
        # The left side but for sign's constant, and its derivative along x.
        f, slope, power = e, e, 1.0
        for i in range(n - 1, -1, -1):
            s, ds = psi(flags, gains, curves, i, e)
            if i < n - 1 or not flags[SIGN]:
                f += weights[0, i] * power * s
                slope += weights[0, i] * power * (q * (n - 1 - i) * s + e * ds)
            power *= w
        if f > target:
            high = x
        else:
            low = x
        change = math.log1p((f - target) / target) * f / slope
        trial = x - change
        if abs(change) <= NEWTON_TOLERANCE:
            x = trial
            break
        # For sign the way from above is monotone. A fuzzy curve has corners: bisect then.
        x = trial if flags[SIGN] or low < trial < high else 0.5 * (low + high)
    e = max(math.exp(x), TINY)
    return e, math.exp(q * x), psi(flags, gains, curves, n - 1, e)[0]


@njit(cache=True, error_model='numpy')
def implicit(
    flags: Ints, gains: Floats, curves: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, gamma: float, y: float, h: float, u: float,
) -> tuple[float, float]:  # fmt: skip
    """
    Backward Euler of D 11 in place, one scalar equation for all levels (D 12).

    Phi is taken at the new sample and the old estimates.

    Parameters
    ----------
    y : float
        Sample at the interval's end.

    Returns
    -------
    (float, float)
        L and dL/dgamma at the interval's end.

    """
    n = gains.shape[1]
    m[0, 0], m[1, 0] = y, 0.0
    for i in range(1, n):
        m[0, i], m[1, i] = x[HAT, i], x[HAT_SENSITIVITY, i]
    above, dabove = 0.0, 0.0
    for i in range(n - 1, -1, -1):
        if offsets[i + 1] > offsets[i]:
            phi, dphi = evaluate(tape, offsets[i], offsets[i + 1], m, u, stack)
            above, dabove = above + phi, dabove + dphi
        above = x[HAT, i] + h * above
        dabove = x[HAT_SENSITIVITY, i] + h * dabove
        x[HAT, i], x[HAT_SENSITIVITY, i] = above, dabove
    return correct(flags, gains, curves, x, m, gamma, y, h)


@njit(cache=True, error_model='numpy')
def predict_correct(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, gamma: float, y: float, h: float, u: float,
) -> tuple[float, float]:  # fmt: skip
    """
    Follow the model to the sample, then correct (D 18), in place.

    Parameters
    ----------
    y : float
        Sample at the interval's end.

    Returns
    -------
    (float, float)
        L and dL/dgamma at the interval's end.

    """
    flow_in_steps(tape, offsets, m, stack, x, h, scalars[PREDICTION_STEP], u)
    if 0.0 < scalars[CORRECTION_PERIOD] < h:
        h = scalars[CORRECTION_PERIOD]
    return correct(flags, gains, curves, x, m, gamma, y, h)


@njit(cache=True, error_model='numpy')
def correct(
    flags: Ints, gains: Floats, curves: Floats,
    x: Floats, m: Floats, gamma: float, y: float, h: float,
) -> tuple[float, float]:  # fmt: skip
    """
    Turn predicted estimates into corrected ones by the solution of D 12 or D 18, in place.

    Parameters
    ----------
    x : (4, N) array
        Rows HAT and HAT_SENSITIVITY: the estimates at the interval's end if eps were 0. The other
        rows are scratch memory.
    m : (2, N) array
        Scratch memory.

    Returns
    -------
    (float, float)
        L and dL/dgamma at the interval's end.

    """
    n = gains.shape[1]
    b, db = y - x[HAT, 0], -x[HAT_SENSITIVITY, 0]
    weight = h
    for i in range(n):
        m[0, i], m[1, i] = weight * gains[LAMBDA, i], weight
        weight *= h
    a, w, top = root(flags, gains, curves, m, abs(b), gamma)
    sliding = flags[SIGN] and a == 0.0
    log_a, deps, power = 0.0, 0.0, 1.0
    if flags[SENSITIVE] and not sliding:  # D 14: implicit function theorem
        log_a = math.log(a) if a > 0.0 else 0.0
        numerator, denominator = db, 1.0
        for i in range(n - 1, -1, -1):
            dp = 2.0 * (n - 1 - i) / n
            value, slope = injection(flags, gains, curves, i, a, power, gamma * dp)
            numerator -= m[0, i] * math.copysign(value, b) * log_a * dp
            denominator += m[0, i] * slope
            power *= w
        deps = numerator / denominator
    power = 1.0
    for i in range(n - 1, -1, -1):  # v_i and its derivative along gamma
        dp = 2.0 * (n - 1 - i) / n
        value, slope = injection(flags, gains, curves, i, a, power, gamma * dp)
        to_gamma = math.copysign(value, b) * log_a * dp
        if i == n - 1:
            value = top
            if sliding:
                to_gamma = db / m[0, i]
        x[TILDE, i] = gains[LAMBDA, i] * math.copysign(value, b)
        x[TILDE_SENSITIVITY, i] = gains[LAMBDA, i] * (to_gamma + slope * deps)
        power *= w
    for i in range(n):
        for j in range(i, n):
            share = m[1, j - i]
            if flags[PREDICTING]:
                share *= SHARES[j, i]
            x[HAT, i] += share * x[TILDE, j]
            x[HAT_SENSITIVITY, i] += share * x[TILDE_SENSITIVITY, j]
    # What the sum above is but for rounding.
    x[HAT, 0] = y - math.copysign(a, b)
    if flags[SENSITIVE]:
        x[HAT_SENSITIVITY, 0] = -deps
    mirror(x)
    return a * a, 2.0 * math.copysign(a, b) * deps
