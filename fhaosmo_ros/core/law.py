# SPDX-License-Identifier: Apache-2.0
"""What the compiled recursions read of a configuration, and the fuzzy sign that they share."""

from typing import NamedTuple

from fhaosmo_ros.core.layout import ROWS
from fhaosmo_ros.core.tape import Floats, Ints
from numba import njit
import numpy as np


class Law(NamedTuple):
    """
    What the kernels read of a configuration; their first arguments, in this order.

    Attributes
    ----------
    flags : (7,) array
        `SIGN` .. `SENSITIVE`: 0 or 1. `IMPLICIT` means that a step uses the sample at its end.
    gains : (4, N) array
        lambda_i, alpha_i, 1 / half-width_i, and the decay of the internal state (0 but for
        those that stand for the unknown input and its derivatives).
    curves : (N, K) array
        psi of each level at K points of [0, half-width].
    scalars : (10,) array
        `EPSILON` .. `CORRECTION_PERIOD`.
    tape, offsets : arrays
        Phi_1 .. Phi_n, and those of the model of the unknown input; see tape.py.

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
    m : (2, n + 1 or N) array
        Measurements m_i of the levels and their sensitivities dm_i / dgamma.
    stack : (2, depth) array
        Of the expression tapes.

    """

    x: Floats
    m: Floats
    stack: Floats


SIGN, IMPLICIT, ADAPTIVE, FROM_MEASUREMENT, LEVANT, PREDICTING, SENSITIVE = range(7)
FLAGS = 7
LAMBDA, ALPHA, INVERSE_WIDTH, DECAY = range(4)
GAINS = 4
EPSILON, GAMMA_INITIAL, RATE, MIN, MAX, DEAD_ZONE, LEAKAGE, DELAY = range(8)
PREDICTION_STEP, CORRECTION_PERIOD = range(8, 10)
SCALARS = 10

NEWTON_STEPS = 60
NEWTON_TOLERANCE = 3e-8
"""Relative change that ends the iteration; its square, about 1e-15, is what is left then."""
TINY = 1e-300
"""Below this an innovation counts as 0: its powers would underflow."""


def make_work(law: Law, depth: int) -> Work:
    """Return scratch memory for a law whose tapes need a stack of `depth`."""
    levels, states = law.gains.shape[1], len(law.offsets) - 1
    return Work(np.zeros((ROWS, levels)), np.zeros((2, states)), np.zeros((2, depth)))


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
