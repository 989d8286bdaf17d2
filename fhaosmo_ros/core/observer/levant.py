# SPDX-License-Identifier: Apache-2.0
"""
Levant's arbitrary-order differentiator with the paper's curves and power, all three schemes.

One innovation drives every level: eps = y - z_hat_1. Equations are cited by their numbers in
docs/mathematics.md (D). The rows TILDE of the state mirror the estimates, z_tilde_{i+1} =
z_hat_{i+1}, so that whatever reads a cascade's state reads this one; theta is 0.

The functions are not inlined, unlike the cascade's: the machine code of a step then stays small
where this structure is not used.

Levant 2003, doi:10.1080/0020717031000099029.
"""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import evaluate, Floats
from fhaosmo_ros.core.model.integrate import NOW, POINT, TOTAL
from fhaosmo_ros.core.observer.arrays import (
    BEYOND,
    CORRECTION_PERIOD,
    COVARIANCE,
    GAMMA,
    HAT,
    HAT_SENSITIVITY,
    INVERSE_STEADY,
    LAMBDA,
    Law,
    NEWTON_STEPS,
    NEWTON_TOLERANCE,
    PERIOD,
    PREDICTING,
    PREDICTION_STEP,
    psi,
    RELAXATION,
    SATURATED,
    SCALE,
    SCHEDULED,
    SENSITIVE,
    SETTLED,
    SIGN,
    SINGLE,
    STEADY,
    STEADY_VARIANCE,
    TILDE,
    TILDE_SENSITIVITY,
    TINY,
    TUNED_OVER_KALMAN,
    VARIANCE,
    WIDEST,
    Work,
)
from fhaosmo_ros.core.observer.covariance import (
    bandwidth,
    correct_covariance,
    doubt_of_noise,
    influence,
    LONG_AGO,
    predict_covariance,
    usual_innovation,
)
from fhaosmo_ros.core.observer.prediction import predict
import numpy as np
from numpy.typing import NDArray

MOST_LEVELS = 16
"""order <= 12, the unknown input, and at most 3 derivatives of it."""


NEAR = 0.25
"""An interval that differs from the tuned one by at most this part of it needs no other gains."""
CLOSE = 0.02
"""Gains that differ from the tuned ones by at most this part of them are replaced by them."""
NEARLY_STEADY = 1.5
"""Up to so many times the steady variance of the innovation, their influence is limited (D 21)."""
SATURATED_SAMPLES = 20
"""So many samples in a row beyond all half-widths widen them."""
RATIO = TOTAL
"""``stages[RATIO, 0]``: factors of the corrections of the levels, P / steady P."""


def deadbeat_shares(count: int) -> NDArray[np.float64]:
    """
    Return the weights of a correction that is deadbeat for a chain of integrators (D 18).

    The i-th derivative's backward difference formula is (-ln(1 - B))^i / h^i, B y_k = y_k -
    y_{k-1}. Cut off after B^j it is exact for polynomials of degree j. Row j of the result says
    what a chain of j + 1 integrators has to take over of a prediction error of its first state,
    so that such a polynomial is known exactly after j + 1 samples.

    Parameters
    ----------
    count : int
        Largest number of integrators.

    Returns
    -------
    (count, count) array
        Weight of the error / h^i in the i-th derivative, row j; 0 for i > j.

    """
    logarithm = np.zeros(count)  # of the power series -ln(1 - x)
    logarithm[1:] = 1.0 / np.arange(1, count)
    power = np.eye(count)[0]
    result = np.zeros((count, count))
    for i in range(count):
        result[:, i] = np.cumsum(power)
        power = np.convolve(power, logarithm)[:count]
    return result


SHARES = deadbeat_shares(MOST_LEVELS)


@compiled(forceinline=True)
def mirror(x: Floats) -> None:
    """Write the internal states that stand for the estimates."""
    last = x.shape[1] - 1
    for i in range(last):
        x[TILDE, i] = x[HAT, i + 1]
        x[TILDE_SENSITIVITY, i] = x[HAT_SENSITIVITY, i + 1]
    x[TILDE, last] = 0.0
    x[TILDE_SENSITIVITY, last] = 0.0


@compiled(forceinline=True)
def injection(law: Law, level: int, a: float, power: float, p: float) -> tuple[float, float]:
    """Return psi(a) |eps|^p and its slope along a = |eps|, given |eps|^p."""
    if a > 0.0:
        s, slope = psi(law, level, a)
        return power * s, power * (p * s / a + slope)
    if law.flags[SIGN] or p > 0.0:
        return 0.0, 0.0
    return 0.0, psi(law, level, 0.0)[1]


@compiled()
def explicit(
    law: Law, work: Work, gamma: float, y: float, h: float, u: Floats
) -> tuple[float, float]:
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
    gains, x, m, n = law.gains, work.x, work.stages[POINT], law.gains.shape[1]
    m[0, 0], m[1, 0] = y, 0.0
    for i in range(1, n):
        m[0, i], m[1, i] = x[HAT, i], x[HAT_SENSITIVITY, i]
    eps, s = y - x[HAT, 0], -x[HAT_SENSITIVITY, 0]
    a = abs(eps)
    log_a = math.log(a) if a > 0.0 else 0.0
    root_power = a ** (2.0 * gamma / n)
    power, follower, dfollower = 1.0, 0.0, 0.0
    for i in range(n - 1, -1, -1):
        phi, dphi = evaluate(law.model, i, m, u, work.stack)
        dp = 2.0 * (n - 1 - i) / n
        value, slope = injection(law, i, a, power, gamma * dp)
        hat, dhat = x[HAT, i], x[HAT_SENSITIVITY, i]
        x[HAT, i] += h * (follower + phi + gains[LAMBDA, i] * math.copysign(value, eps))
        if law.flags[SENSITIVE]:  # D 13
            to_gamma = math.copysign(value, eps) * log_a * dp
            x[HAT_SENSITIVITY, i] += h * (
                dfollower + dphi + gains[LAMBDA, i] * (to_gamma + slope * s)
            )
        follower, dfollower = hat, dhat
        power *= root_power
    mirror(x)
    return eps * eps, 2.0 * eps * s


@compiled(forceinline=True)
def root(law: Law, weights: Floats, b: float, gamma: float) -> tuple[float, float, float]:
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
    n, is_sign = law.gains.shape[1], law.flags[SIGN]
    if b < TINY:
        return 0.0, 0.0, 0.0
    constant = 0.0
    if is_sign:
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
            s, ds = psi(law, i, e)
            if i < n - 1 or not is_sign:
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
        x = trial if is_sign or low < trial < high else 0.5 * (low + high)
    e = max(math.exp(x), TINY)
    return e, math.exp(q * x), psi(law, n - 1, e)[0]


@compiled()
def implicit(
    law: Law, work: Work, memory: Floats, y: float, h: float, u: Floats
) -> tuple[float, float]:
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
    x, m, n = work.x, work.stages[POINT], law.gains.shape[1]
    m[0, 0], m[1, 0] = y, 0.0
    for i in range(1, n):
        m[0, i], m[1, i] = x[HAT, i], x[HAT_SENSITIVITY, i]
    above, dabove = 0.0, 0.0
    for i in range(n - 1, -1, -1):
        phi, dphi = evaluate(law.model, i, m, u, work.stack)
        above, dabove = above + phi, dabove + dphi
        above = x[HAT, i] + h * above
        dabove = x[HAT_SENSITIVITY, i] + h * dabove
        x[HAT, i], x[HAT_SENSITIVITY, i] = above, dabove
    even(work)
    return correct(law, work, memory, y, h)


@compiled()
def predict_correct(
    law: Law, work: Work, memory: Floats, y: float, h: float, u: Floats
) -> tuple[float, float]:
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
    x, n, stages = work.x, law.gains.shape[1], work.stages
    scheduled = law.flags[SCHEDULED] and not holds(law, memory, h)
    variance, doubt = law.scalars[STEADY_VARIANCE], 1.0
    if scheduled:
        if memory[SETTLED] > 0.0:
            for i in range(n):
                for j in range(n):
                    x[COVARIANCE + i, j] = law.chances[STEADY * n + i, j]
            correct_covariance(law, work, 1.0)
            memory[SETTLED] = -LONG_AGO
        doubt = doubt_of_noise(-memory[SETTLED], bandwidth(law, law.scalars[CORRECTION_PERIOD]))
        predict_covariance(law, work, h)
        variance = x[COVARIANCE, 0] + doubt * doubt * law.scalars[VARIANCE]
    for i in range(n):
        stages[NOW, 0, i], stages[NOW, 1, i] = x[HAT, i], x[HAT_SENSITIVITY, i]
    predict(law, work, h, u, law.scalars[PREDICTION_STEP])
    for i in range(n):
        x[HAT, i], x[HAT_SENSITIVITY, i] = stages[NOW, 0, i], stages[NOW, 1, i]
    period = law.scalars[CORRECTION_PERIOD]
    if not law.flags[SCHEDULED]:
        even(work)
        if period > 0.0:  # not below the mean interval: another rate is no gap
            h = min(h, max(period, memory[PERIOD]))
        return correct(law, work, memory, y, h)
    b, ratio = y - x[HAT, 0], stages[RATIO, 0]
    usual = usual_innovation(memory, b, math.sqrt(variance))
    if variance < NEARLY_STEADY * law.scalars[STEADY_VARIANCE]:  # a large P counts on all of b
        y = x[HAT, 0] + influence(memory, b, usual)
    if memory[BEYOND] > 0.0:
        return 0.0, 0.0
    even(work)
    if scheduled:
        far, largest = abs(h - period) > NEAR * period, 1.0
        for i in range(n):  # D 20
            inverse = law.chances[SINGLE * n + INVERSE_STEADY, i]
            ratio[i] = x[COVARIANCE, i] * inverse if inverse > 0.0 else ratio[0]
            ratio[i] /= doubt * doubt
            largest = max(largest, ratio[i])
            far = far or abs(ratio[i] - 1.0) > CLOSE
        for i in range(n):  # from the Kalman filter's gains to the tuned ones
            ratio[i] *= law.chances[SINGLE * n + TUNED_OVER_KALMAN, i] ** (1.0 / largest - 1.0)
        correct_covariance(law, work, doubt)
        memory[SETTLED] = memory[SETTLED] - h if far else 1.0
    return correct(law, work, memory, y, period)


@compiled(forceinline=True)
def even(work: Work) -> None:
    """Let every level be corrected by its tuned gain."""
    for i in range(work.stages.shape[2]):
        work.stages[RATIO, 0, i] = 1.0


@compiled(forceinline=True)
def holds(law: Law, memory: Floats, h: float) -> bool:
    """Return True while the tuned gains are the right ones: steady, at the tuned rate."""
    period = law.scalars[CORRECTION_PERIOD]
    return bool(memory[SETTLED] > 0.0 and abs(h - period) <= NEAR * period)


@compiled(forceinline=True)
def grow(law: Law, memory: Floats, a: float, h: float) -> None:
    """Widen the fuzzy sets while all of them have been saturated for long (D 22)."""
    if a > law.scalars[WIDEST]:
        memory[SATURATED] += 1.0
        if memory[SATURATED] >= SATURATED_SAMPLES:
            memory[SCALE] *= 2.0
    else:
        memory[SATURATED] = 0.0
        memory[SCALE] = 1.0 + (memory[SCALE] - 1.0) / (1.0 + h * law.scalars[RELAXATION])


@compiled()
def correct(law: Law, work: Work, memory: Floats, y: float, h: float) -> tuple[float, float]:
    """
    Turn predicted estimates into corrected ones by the solution of D 12 or D 18, in place.

    Parameters
    ----------
    work : Work
        Rows HAT and HAT_SENSITIVITY of ``x``: the estimates at the interval's end if eps were 0.

    Returns
    -------
    (float, float)
        L and dL/dgamma at the interval's end.

    """
    flags, gains, n = law.flags, law.gains, law.gains.shape[1]
    x, m = work.x, work.stages[POINT]
    ratio, scale, gamma = work.stages[RATIO, 0], memory[SCALE], memory[GAMMA]
    b, db = (y - x[HAT, 0]) / scale, -x[HAT_SENSITIVITY, 0] / scale  # D 22
    weight = h
    for i in range(n):
        m[0, i], m[1, i] = ratio[0] * weight * gains[LAMBDA, i], weight
        weight *= h
    a, w, top = root(law, m, abs(b), gamma)
    sliding = flags[SIGN] and a == 0.0
    log_a, deps, power = 0.0, 0.0, 1.0
    if flags[SENSITIVE] and not sliding:  # D 14: implicit function theorem
        log_a = math.log(a) if a > 0.0 else 0.0
        numerator, denominator = db, 1.0
        for i in range(n - 1, -1, -1):
            dp = 2.0 * (n - 1 - i) / n
            value, slope = injection(law, i, a, power, gamma * dp)
            numerator -= m[0, i] * math.copysign(value, b) * log_a * dp
            denominator += m[0, i] * slope
            power *= w
        deps = numerator / denominator
    power = 1.0
    for i in range(n - 1, -1, -1):  # v_i and its derivative along gamma
        dp = 2.0 * (n - 1 - i) / n
        value, slope = injection(law, i, a, power, gamma * dp)
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
            share = scale * ratio[i] * m[1, j - i]
            if flags[PREDICTING]:
                share *= SHARES[j, i]
            x[HAT, i] += share * x[TILDE, j]
            x[HAT_SENSITIVITY, i] += share * x[TILDE_SENSITIVITY, j]
    grow(law, memory, a, h)
    a, deps = scale * a, scale * deps
    # What the sum above is but for rounding.
    x[HAT, 0] = y - math.copysign(a, b)
    if flags[SENSITIVE]:
        x[HAT_SENSITIVITY, 0] = -deps
    mirror(x)
    return a * a, 2.0 * math.copysign(a, b) * deps
