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
    flags : (5,) array
        `SIGN` .. `LEVANT`: 0 or 1.
    gains : (4, N) array
        lambda_i, alpha_i, 1 / half-width_i, and the decay of the internal state (0 but for the
        one that stands for the unknown input).
    curves : (N, K) array
        psi of each level at K points of [0, half-width].
    scalars : (8,) array
        `EPSILON` .. `DELAY`.
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


SIGN, IMPLICIT, ADAPTIVE, FROM_MEASUREMENT, LEVANT = range(5)
FLAGS = 5
LAMBDA, ALPHA, INVERSE_WIDTH, DECAY = range(4)
GAINS = 4
EPSILON, GAMMA_INITIAL, RATE, MIN, MAX, DEAD_ZONE, LEAKAGE, DELAY = range(8)
SCALARS = 8

NEWTON_STEPS = 60
NEWTON_TOLERANCE = 1e-9
"""Relative change that ends the iteration; its square, about 1e-18, is what is left then."""
TINY = 1e-300
"""Below this an innovation counts as 0: its powers would underflow."""


def make_work(levels: int, depth: int) -> Work:
    """Return scratch memory for `levels` levels and tapes of the given stack depth."""
    return Work(np.zeros((ROWS, levels)), np.zeros((2, levels)), np.zeros((2, depth)))


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
