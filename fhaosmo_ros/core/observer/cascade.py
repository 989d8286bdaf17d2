# SPDX-License-Identifier: Apache-2.0
"""
The paper's observer, a cascade of super-twisting levels: every variant, both schemes.

Equations are cited as P (paper: label of the equation) and D (number in docs/mathematics.md).
The super-twisting algorithm: Levant 1998 (doi:10.1016/S0005-1098(97)00209-4), Moreno and Osorio
2012 (doi:10.1109/TAC.2012.2186179); its implicit discretisation: Acary and Brogliato 2010
(doi:10.1016/j.sysconle.2010.03.002).
"""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import evaluate, Floats
from fhaosmo_ros.core.model.integrate import POINT
from fhaosmo_ros.core.observer.arrays import (
    ADAPTIVE,
    ALPHA,
    DECAY,
    EPSILON,
    HAT,
    HAT_SENSITIVITY,
    LAMBDA,
    Law,
    NEWTON_STEPS,
    NEWTON_TOLERANCE,
    psi,
    SENSITIVE,
    SIGN,
    TILDE,
    TILDE_SENSITIVITY,
    TINY,
    Work,
)


@compiled(forceinline=True)
def kept(gains: Floats, level: int, h: float) -> float:
    """Return the factor by which a backward Euler step shrinks an internal state (D 16)."""
    return 1.0 / (1.0 + h * gains[DECAY, level]) if gains[DECAY, level] > 0.0 else 1.0


@compiled(forceinline=True)
def root(law: Law, level: int, b: float, h: float, gamma: float) -> tuple[float, float]:
    """
    Solve eps + h lambda |eps|^gamma s + h^2 alpha s = b, s in psi(eps), for b >= 0 (D 9, D 16).

    Returns
    -------
    (float, float)
        eps >= 0 and s. The left side increases with eps, so there is one root in [0, b].

    """
    gains, is_sign = law.gains, law.flags[SIGN]
    damping = h * gains[LAMBDA, level]
    stiffness = h * h * gains[ALPHA, level] * kept(gains, level, h)
    if b < TINY:
        return 0.0, 0.0
    if is_sign and b <= stiffness:
        return 0.0, b / stiffness  # sliding: the set-valued sign takes what is needed
    if is_sign and gamma == 0.5:
        rest = b - stiffness
        # The positive root of r^2 + damping r - rest, in the form that does not cancel.
        r = 2.0 * rest / (damping + math.sqrt(damping * damping + 4.0 * rest))
        return r * r, 1.0
    if is_sign:
        # Both bounds are above the root. From there Newton's method on the logarithm of the left
        # side over that of e is monotone (it is convex), and quick however small gamma is.
        rest = b - stiffness
        x = min(math.log(rest), math.log(rest / damping) / gamma)
        for _ in range(NEWTON_STEPS):
            e, power = math.exp(x), damping * math.exp(gamma * x)
            f = e + power
            change = math.log1p((f - rest) / rest) * f / (e + gamma * power)
            x -= change
            if abs(change) <= NEWTON_TOLERANCE:
                break
        return max(math.exp(x), TINY), 1.0
    low, high = 0.0, b
    _, slope = psi(law, level, 0.0)
    e = b / (1.0 + stiffness * slope)
    for _ in range(NEWTON_STEPS):
        s, ds = psi(law, level, e)
        power = math.sqrt(e) if gamma == 0.5 else e**gamma
        f = e + (damping * power + stiffness) * s - b
        if f > 0.0:
            high = e
        else:
            low = e
        slope = 1.0 + damping * (gamma * power / e * s + power * ds) + stiffness * ds
        change = f / slope
        trial = e - change
        if abs(change) <= NEWTON_TOLERANCE * e:
            e = trial
            break
        e = trial if low < trial < high else 0.5 * (low + high)
    s, _ = psi(law, level, e)
    return e, s


@compiled(forceinline=True)
def explicit(
    law: Law, work: Work, gamma: float, y: float, h: float, u: Floats
) -> tuple[float, float]:
    """
    Forward Euler of P adaptivesupertwistingobserverfuzzymodified, in place.

    With psi = sign and gamma = 1/2 it is P triangularObserver, with gamma = 1/2 P fuzzysuper.

    Parameters
    ----------
    y : float
        Sample at the interval's beginning.

    Returns
    -------
    (float, float)
        L and dL/dgamma at the interval's beginning.

    """
    flags, gains, epsilon = law.flags, law.gains, law.scalars[EPSILON]
    x, m, n = work.x, work.stages[POINT], law.gains.shape[1]
    loss, gradient = 0.0, 0.0
    m[0, 0], m[1, 0] = y, 0.0
    for i in range(1, n):
        m[0, i], m[1, i] = x[TILDE, i - 1], x[TILDE_SENSITIVITY, i - 1]  # m_i = z_tilde_i
    running = True
    for i in range(n):
        eps = m[0, i] - x[HAT, i]
        s = m[1, i] - x[HAT_SENSITIVITY, i]  # s_i = d eps_i / d gamma
        loss += eps * eps  # P lossfunction
        gradient += 2.0 * eps * s
        if not running:
            continue  # P Eifunction: E_{i-1} = 0 holds the level
        phi, dphi = evaluate(law.model, i, m, u, work.stack)
        a = abs(eps)
        direction, slope, injection, dinjection = 0.0, 0.0, 0.0, 0.0
        if a > 0.0:
            direction, slope = psi(law, i, a)
            direction = math.copysign(direction, eps)
            if flags[ADAPTIVE]:
                log_a = math.log(a)
                power = math.exp(gamma * log_a)
                injection = gains[LAMBDA, i] * power * direction
                if flags[SENSITIVE]:
                    # D 6: explicit dependence on gamma, and the chain through eps
                    dinjection = injection * log_a + gains[LAMBDA, i] * power * s * (
                        gamma * abs(direction) / a + slope
                    )
            else:
                injection = gains[LAMBDA, i] * math.sqrt(a) * direction
        elif not flags[SIGN]:
            _, slope = psi(law, i, 0.0)
        if flags[SENSITIVE]:
            x[HAT_SENSITIVITY, i] += h * (x[TILDE_SENSITIVITY, i] + dinjection + dphi)
            x[TILDE_SENSITIVITY, i] += h * (
                gains[ALPHA, i] * slope * s - gains[DECAY, i] * x[TILDE_SENSITIVITY, i]
            )
        x[HAT, i] += h * (x[TILDE, i] + injection + phi)  # P: z_hat_i'
        # P: z_tilde_{i+1}', and D 15
        x[TILDE, i] += h * (gains[ALPHA, i] * direction - gains[DECAY, i] * x[TILDE, i])
        running = a <= epsilon  # P Eifunction
    return loss, gradient


@compiled(forceinline=True)
def implicit(
    law: Law, work: Work, gamma: float, y: float, h: float, u: Floats
) -> tuple[float, float]:
    """
    Backward Euler of the same equations in place, one scalar equation a level (D 9).

    Parameters
    ----------
    y : float
        Sample at the interval's end.

    Returns
    -------
    (float, float)
        L and dL/dgamma at the interval's end.

    """
    flags, gains, epsilon = law.flags, law.gains, law.scalars[EPSILON]
    x, m, n = work.x, work.stages[POINT], law.gains.shape[1]
    loss, gradient = 0.0, 0.0
    running = True
    for i in range(n):
        if i == 0:
            m[0, 0], m[1, 0] = y, 0.0
        else:  # already at the new time
            m[0, i], m[1, i] = x[TILDE, i - 1], x[TILDE_SENSITIVITY, i - 1]
        if not running:
            held = m[0, i] - x[HAT, i]
            loss += held * held
            gradient += 2.0 * held * (m[1, i] - x[HAT_SENSITIVITY, i])
            continue
        phi, dphi = evaluate(law.model, i, m, u, work.stack)
        keep = kept(gains, i, h)
        x[TILDE, i] *= keep
        b = m[0, i] - x[HAT, i] - h * (x[TILDE, i] + phi)
        a, s = root(law, i, abs(b), h, gamma)
        loss += a * a  # P lossfunction
        if flags[SENSITIVE]:  # D 10: implicit function theorem on the equation of `root`
            x[TILDE_SENSITIVITY, i] *= keep
            db = m[1, i] - x[HAT_SENSITIVITY, i] - h * (x[TILDE_SENSITIVITY, i] + dphi)
            damping, stiffness = h * gains[LAMBDA, i], h * h * gains[ALPHA, i] * keep
            _, slope = psi(law, i, a)
            if a > 0.0:
                log_a = math.log(a)
                power = math.exp(gamma * log_a)
                deps = (db - math.copysign(damping * power * s, b) * log_a) / (
                    1.0 + damping * power * (gamma * s / a + slope) + stiffness * slope
                )
                dpsi = slope * deps
            elif flags[SIGN]:  # sliding: s = b / (h^2 alpha)
                deps, dpsi = 0.0, db / stiffness
            else:
                deps = db / (1.0 + stiffness * slope)
                dpsi = slope * deps
            x[TILDE_SENSITIVITY, i] += h * keep * gains[ALPHA, i] * dpsi
            x[HAT_SENSITIVITY, i] = m[1, i] - deps
            gradient += 2.0 * math.copysign(a, b) * deps
        x[TILDE, i] += h * keep * gains[ALPHA, i] * math.copysign(s, b)
        x[HAT, i] = m[0, i] - math.copysign(a, b)
        running = a <= epsilon  # P Eifunction
    return loss, gradient
