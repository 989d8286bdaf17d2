# SPDX-License-Identifier: Apache-2.0
"""Where the paper stops: the implicit scheme, 2,000 s of adaptation, measurement noise."""

from collections.abc import Callable
from typing import NamedTuple

from fhaosmo_ros.core.metrics import rms
from fhaosmo_ros.tools.paper_cases import CONVERGED, FREQUENCIES, sampled, Score, score
import numpy as np
from numpy.typing import NDArray

VARIANTS = ('sign', 'fuzzy', 'fuzzy_adaptive')
NOISES = (1e-4, 1e-3, 1e-2)
"""Standard deviations of the noise on y; the amplitude of z1 is of order 0.1 to 1."""
HOURS = 2000.0
WINDOW = 100.0
"""The drift of the long run is judged in windows of this many seconds."""
WORSE = 1.05
"""Adaptation may be this many times worse than none."""


class Row(NamedTuple):
    """One cell of the table beyond the paper."""

    variant: str
    scheme: str
    step: float
    omega: float
    noise: float
    score: Score


class LongRun(NamedTuple):
    """
    A long run.

    Attributes
    ----------
    scheme, omega : str and float
    t, rms_d, gamma : (K,) arrays
        End of each window, RMS error of d within it, gamma at its end.
    fixed : float
        RMS error of d of the same observer without adaptation, in the last window.

    """

    scheme: str
    omega: float
    t: NDArray[np.float64]
    rms_d: NDArray[np.float64]
    gamma: NDArray[np.float64]
    fixed: float


def _row(variant: str, scheme: str, step: float, omega: float, noise: float) -> Row:
    run = sampled(variant, omega, step, scheme, noise)
    return Row(variant, scheme, step, omega, noise, score(run))


def schemes(tick: Callable[[], object]) -> list[Row]:
    """Measure sampled observers without noise: explicit at 1e-3 s, implicit at 1e-3 and 1e-2 s."""
    rows = []
    for scheme, step in (('explicit', 1e-3), ('implicit', 1e-3), ('implicit', 1e-2)):
        rows += [_row(v, scheme, step, w, 0.0) for w in FREQUENCIES for v in VARIANTS]
        tick()
    return rows


def noises(tick: Callable[[], object]) -> list[Row]:
    """Measure them with noise on y, at 1e-3 s and the low frequency."""
    rows = []
    for noise in NOISES:
        for scheme in ('explicit', 'implicit'):
            rows += [_row(v, scheme, 1e-3, FREQUENCIES[0], noise) for v in VARIANTS]
        tick()
    return rows


def long_run(scheme: str, omega: float, duration: float) -> LongRun:
    """Let gamma adapt for hours, and look whether it drifts and whether d gets worse."""

    def windows(variant: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        run = sampled(variant, omega, 1e-3, scheme, duration=duration + CONVERGED)
        first, size = round(CONVERGED / 1e-3), round(WINDOW / 1e-3)
        error = run.z_hat[:, -1] - run.unknown_input
        starts = range(first, len(error) - size, size)
        return (
            np.array([rms(error[k : k + size]) for k in starts]),
            np.array([run.gamma[k + size] for k in starts]),
        )

    rms_d, gamma = windows('fuzzy_adaptive')
    fixed, _ = windows('fuzzy')
    t = CONVERGED + WINDOW * np.arange(1, len(rms_d) + 1)
    return LongRun(scheme, omega, t, rms_d, gamma, float(fixed[-1]))
