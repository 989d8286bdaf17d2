# SPDX-License-Identifier: Apache-2.0
"""
The compiled recursion: every variant, both schemes, and the exact sensitivity to gamma.

Equations are cited as P (paper: label of the equation) and D (number in docs/mathematics.md).
The state's layout is described in layout.py.
"""

import math
from typing import NamedTuple

from fhaosmo_ros.core.borrowed import borrowed
from fhaosmo_ros.core.layout import (
    GAMMA,
    HAT,
    HAT_SENSITIVITY,
    PENDING,
    ROWS,
    TILDE,
    TILDE_SENSITIVITY,
    Y,
)
from fhaosmo_ros.core.status import LEVEL_SHIFT, Status
from fhaosmo_ros.core.tape import evaluate, Floats, Ints
from numba import njit
import numpy as np

# Plain integers: numba reads them as constants.
REJECTED_MEASUREMENT = int(Status.REJECTED_MEASUREMENT)
REJECTED_PERIOD = int(Status.REJECTED_PERIOD)
REJECTED_INPUT = int(Status.REJECTED_INPUT)
REJECTED_STEP = int(Status.REJECTED_STEP)
AT_MIN = int(Status.GAMMA_AT_MIN)
AT_MAX = int(Status.GAMMA_AT_MAX)
SENSITIVITY_RESET = int(Status.SENSITIVITY_RESET)

SENSITIVITY_LIMIT = 1e9
NEWTON_STEPS = 60
NEWTON_TOLERANCE = 1e-9
"""Relative change that ends the iteration; its square, about 1e-18, is what is left then."""
HEADROOM = 1e8
"""A number counts as infinite if this many times it would be: differences then stay finite."""
TINY = 1e-300
"""Below this an innovation counts as 0: its powers would underflow."""


class Law(NamedTuple):
    """
    What the kernels read of a configuration; their first arguments, in this order.

    Attributes
    ----------
    flags : (4,) array
        `SIGN` .. `FROM_MEASUREMENT`: 0 or 1.
    gains : (3, N) array
        lambda_i, alpha_i, 1 / half-width_i.
    curves : (N, K) array
        psi of each level at K points of [0, half-width].
    scalars : (7,) array
        `EPSILON` .. `LEAKAGE`.
    tape, offsets : arrays
        Phi_1 .. Phi_N; see tape.py.

    """

    flags: Ints
    gains: Floats
    curves: Floats
    scalars: Floats
    tape: Floats
    offsets: Ints


class Work(NamedTuple):
    """
    Scratch memory of the kernels; their next arguments, in this order.

    Attributes
    ----------
    x : (4, N) array
        Candidate levels.
    m : (2, N) array
        Measurements m_i of the levels and their sensitivities dm_i / dgamma.
    stack : (2, depth) array
        Of the expression tapes.

    """

    x: Floats
    m: Floats
    stack: Floats


SIGN, IMPLICIT, ADAPTIVE, FROM_MEASUREMENT = range(4)
FLAGS = 4
LAMBDA, ALPHA, INVERSE_WIDTH = range(3)
EPSILON, GAMMA_INITIAL, RATE, MIN, MAX, DEAD_ZONE, LEAKAGE = range(7)
SCALARS = 7


@njit(cache=True, error_model='numpy', forceinline=True)
def psi(flags: Ints, gains: Floats, curves: Floats, level: int, a: float) -> tuple[float, float]:
    """Return the fuzzy sign at a = |eps| > 0, and its slope; it is odd, so that is all of it."""
    if flags[SIGN]:
        return 1.0, 0.0
    last = curves.shape[1] - 1
    scale = gains[INVERSE_WIDTH, level] * last
    position = a * scale
    if not position < last:
        return curves[level, last], 0.0
    j = int(position)
    rise = curves[level, j + 1] - curves[level, j]
    return curves[level, j] + (position - j) * rise, rise * scale


@njit(cache=True, error_model='numpy', forceinline=True)
def root(
    flags: Ints, gains: Floats, curves: Floats, level: int, b: float, h: float, gamma: float
) -> tuple[float, float]:
    """
    Solve eps + h lambda |eps|^gamma s + h^2 alpha s = b, s in psi(eps), for b >= 0 (D 9).

    Returns
    -------
    (float, float)
        eps >= 0 and s. The left side increases with eps, so there is one root in [0, b].

    """
    damping = h * gains[LAMBDA, level]
    stiffness = h * h * gains[ALPHA, level]
    if b < TINY:
        return 0.0, 0.0
    if flags[SIGN] and b <= stiffness:
        return 0.0, b / stiffness  # sliding: the set-valued sign takes what is needed
    if flags[SIGN] and gamma == 0.5:
        rest = b - stiffness
        # The positive root of r^2 + damping r - rest, in the form that does not cancel.
        r = 2.0 * rest / (damping + math.sqrt(damping * damping + 4.0 * rest))
        return r * r, 1.0
    low, high = 0.0, b
    if flags[SIGN]:
        e = b - stiffness
    else:
        _, slope = psi(flags, gains, curves, level, 0.0)
        e = b / (1.0 + stiffness * slope)
    for _ in range(NEWTON_STEPS):
        s, ds = psi(flags, gains, curves, level, e)
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
    s, _ = psi(flags, gains, curves, level, e)
    return e, s


@njit(cache=True, error_model='numpy', forceinline=True)
def explicit(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, gamma: float, y: float, h: float, u: float,
) -> tuple[float, float]:  # fmt: skip
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
    n = gains.shape[1]
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
        phi, dphi = 0.0, 0.0
        if offsets[i + 1] > offsets[i]:
            phi, dphi = evaluate(tape, offsets[i], offsets[i + 1], m, u, stack)
        a = abs(eps)
        direction, slope, injection, dinjection = 0.0, 0.0, 0.0, 0.0
        if a > 0.0:
            direction, slope = psi(flags, gains, curves, i, a)
            direction = math.copysign(direction, eps)
            if flags[ADAPTIVE]:
                log_a = math.log(a)
                power = math.exp(gamma * log_a)
                injection = gains[LAMBDA, i] * power * direction
                # D 6: explicit dependence on gamma, and the chain through eps
                dinjection = injection * log_a + gains[LAMBDA, i] * power * s * (
                    gamma * abs(direction) / a + slope
                )
            else:
                injection = gains[LAMBDA, i] * math.sqrt(a) * direction
        elif not flags[SIGN]:
            _, slope = psi(flags, gains, curves, i, 0.0)
        if flags[ADAPTIVE]:
            x[HAT_SENSITIVITY, i] += h * (x[TILDE_SENSITIVITY, i] + dinjection + dphi)
            x[TILDE_SENSITIVITY, i] += h * gains[ALPHA, i] * slope * s
        x[HAT, i] += h * (x[TILDE, i] + injection + phi)  # P: z_hat_i'
        x[TILDE, i] += h * gains[ALPHA, i] * direction  # P: z_tilde_{i+1}'
        running = a <= scalars[EPSILON]
    return loss, gradient


@njit(cache=True, error_model='numpy', forceinline=True)
def implicit(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, gamma: float, y: float, h: float, u: float,
) -> tuple[float, float]:  # fmt: skip
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
    n = gains.shape[1]
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
        phi, dphi = 0.0, 0.0
        if offsets[i + 1] > offsets[i]:
            phi, dphi = evaluate(tape, offsets[i], offsets[i + 1], m, u, stack)
        b = m[0, i] - x[HAT, i] - h * (x[TILDE, i] + phi)
        a, s = root(flags, gains, curves, i, abs(b), h, gamma)
        loss += a * a  # P lossfunction
        if flags[ADAPTIVE]:  # D 10: implicit function theorem on the equation of `root`
            db = m[1, i] - x[HAT_SENSITIVITY, i] - h * (x[TILDE_SENSITIVITY, i] + dphi)
            damping, stiffness = h * gains[LAMBDA, i], h * h * gains[ALPHA, i]
            _, slope = psi(flags, gains, curves, i, a)
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
            x[TILDE_SENSITIVITY, i] += h * gains[ALPHA, i] * dpsi
            x[HAT_SENSITIVITY, i] = m[1, i] - deps
            gradient += 2.0 * math.copysign(a, b) * deps
        x[TILDE, i] += h * gains[ALPHA, i] * math.copysign(s, b)
        x[HAT, i] = m[0, i] - math.copysign(a, b)
        running = a <= scalars[EPSILON]  # P Eifunction
    return loss, gradient


@njit(cache=True, error_model='numpy', forceinline=True)
def innovations(scalars: Floats, levels: Floats, y: float, eps: Floats, row: int) -> int:
    """Write eps_i = m_i - z_hat_i into a row of `eps`; return the number of open levels."""
    count, running = 0, True
    for i in range(levels.shape[1]):
        m = y if i == 0 else levels[TILDE, i - 1]
        eps[row, i] = m - levels[HAT, i]
        if running:
            count += 1
        running = running and abs(eps[row, i]) <= scalars[EPSILON]  # P Eifunction
    return count


@njit(cache=True, error_model='numpy', forceinline=True)
def start(
    flags: Ints, scalars: Floats, levels: Floats, memory: Floats, y: float, eps: Floats, row: int
) -> int:
    """
    Take `y` as the first sample if it is one: time has not passed, nothing is integrated.

    Returns
    -------
    int
        Status word (see status.py).

    """
    word = 0
    if math.isfinite(HEADROOM * y):
        memory[Y] = y
        memory[PENDING] = 0.0
        if flags[FROM_MEASUREMENT]:
            levels[HAT, 0] = y
    else:
        word = REJECTED_MEASUREMENT
    return word | (innovations(scalars, levels, memory[Y], eps, row) << LEVEL_SHIFT)


@njit(cache=True, error_model='numpy', forceinline=True)
def step(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    levels: Floats, memory: Floats, y: float, h: float, u: float, eps: Floats, row: int,
) -> int:  # fmt: skip
    """
    Advance a state in place to the sample `y` that lies `h` seconds after the last call.

    Returns
    -------
    int
        Status word (see status.py). A rejected sample changes no level; see `Status`.

    """
    n = gains.shape[1]
    word = 0
    if not math.isfinite(HEADROOM * y):
        word |= REJECTED_MEASUREMENT
    if not math.isfinite(u):
        word |= REJECTED_INPUT
    if not (h > 0.0 and math.isfinite(HEADROOM * h)):
        word |= REJECTED_PERIOD
    if not word:
        for r in range(ROWS):
            for i in range(n):
                x[r, i] = levels[r, i]
        gamma, whole = memory[GAMMA], h + memory[PENDING]
        if flags[IMPLICIT]:
            loss, gradient = implicit(
                flags, gains, curves, scalars, tape, offsets, x, m, stack, gamma, y, whole, u
            )
        else:
            loss, gradient = explicit(
                flags, gains, curves, scalars, tape, offsets,
                x, m, stack, gamma, memory[Y], whole, u,
            )  # fmt: skip
        zero = 0.0
        for i in range(n):
            hat, tilde = HEADROOM * x[HAT, i], HEADROOM * x[TILDE, i]
            zero += (hat - hat) + (tilde - tilde)
        if zero != 0.0:  # a difference of equals is 0, and NaN if they are not finite
            word = REJECTED_STEP
            # Nothing of the sample may make the next step fail as well: not its time, and not
            # the y at the interval's beginning, which is what fails explicitly.
            memory[PENDING] = 0.0
            if not flags[IMPLICIT]:
                memory[Y] = y
        else:
            if flags[ADAPTIVE]:
                memory[GAMMA], word = adapt(scalars, x, gamma, whole, loss, gradient)
            for r in range(ROWS):
                for i in range(n):
                    levels[r, i] = x[r, i]
            memory[Y] = y
            memory[PENDING] = 0.0
    if word & (REJECTED_MEASUREMENT | REJECTED_INPUT) and not word & REJECTED_PERIOD:
        memory[PENDING] += h
    return word | (innovations(scalars, levels, memory[Y], eps, row) << LEVEL_SHIFT)


@njit(cache=True, error_model='numpy', forceinline=True)
def adapt(
    c: Floats, x: Floats, gamma: float, h: float, loss: float, gradient: float
) -> tuple[float, int]:
    """
    Return the next gamma (P adaptationlawgamma) and its status flags.

    Projection on [gamma_min, gamma_max], dead zone and leakage are ours (D 8).
    """
    word = 0
    zero = gradient - gradient
    for r in (HAT_SENSITIVITY, TILDE_SENSITIVITY):
        for i in range(x.shape[1]):
            if not abs(x[r, i]) < SENSITIVITY_LIMIT:
                word = SENSITIVITY_RESET
    if word or zero != 0.0:
        word = SENSITIVITY_RESET
        for r in (HAT_SENSITIVITY, TILDE_SENSITIVITY):
            for i in range(x.shape[1]):
                x[r, i] = 0.0
    elif loss > c[DEAD_ZONE] * c[DEAD_ZONE]:
        gamma -= h * c[RATE] * gradient  # P adaptationlawgamma
    gamma -= min(h * c[LEAKAGE], 1.0) * (gamma - c[GAMMA_INITIAL])
    if not gamma > c[MIN]:  # also for NaN, from an infinite gradient step
        gamma = c[MIN]
        word |= AT_MIN
    elif gamma >= c[MAX]:
        gamma = c[MAX]
        word |= AT_MAX
    return gamma, word


@njit(cache=True, error_model='numpy')
def step_once(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    levels: Floats, memory: Floats, y: float, h: float, u: float, eps: Floats,
) -> int:  # fmt: skip
    """Advance by one sample; see `step`. The innovations go to eps[0]."""
    return step(
        flags, gains, curves, scalars, tape, offsets, x, m, stack,
        levels, memory, y, h, u, eps, 0,
    )  # fmt: skip


@njit(cache=True, error_model='numpy')
def run(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    levels: Floats, memory: Floats, y: Floats, h: Floats, u: Floats,
    out: Floats, gamma: Floats, eps: Floats, words: Ints, first: int, every: int,
) -> None:  # fmt: skip
    """
    Start with the samples before index `first`, step from it on; record every `every`-th one.

    Row r of `out` (rows, 2, N), `gamma`, `eps` and `words` is the state after sample
    (r + 1) * every - 1; `eps` has one row more, for the samples after the last such one.
    """
    flags, gains, curves, scalars = (
        borrowed(flags), borrowed(gains), borrowed(curves), borrowed(scalars)
    )  # fmt: skip
    tape, offsets = borrowed(tape), borrowed(offsets)
    x, m, stack = borrowed(x), borrowed(m), borrowed(stack)
    levels, memory, eps = borrowed(levels), borrowed(memory), borrowed(eps)
    row, seen = 0, 0
    for k in range(y.shape[0]):
        if k >= first:
            word = step(
                flags, gains, curves, scalars, tape, offsets, x, m, stack,
                levels, memory, y[k], h[k], u[k], eps, row,
            )  # fmt: skip
        else:
            word = start(flags, scalars, levels, memory, y[k], eps, row)
        seen |= word & ((1 << LEVEL_SHIFT) - 1)
        if (k + 1) % every == 0:
            for i in range(levels.shape[1]):
                out[row, HAT, i] = levels[HAT, i]
                out[row, TILDE, i] = levels[TILDE, i]
            gamma[row] = memory[GAMMA]
            words[row] = (word >> LEVEL_SHIFT << LEVEL_SHIFT) | seen
            seen = 0
            row += 1


def make_work(levels: int, depth: int) -> Work:
    """Return scratch memory for `levels` levels and tapes of the given stack depth."""
    return Work(np.zeros((ROWS, levels)), np.zeros((2, levels)), np.zeros((2, depth)))
