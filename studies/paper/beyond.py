# SPDX-License-Identifier: Apache-2.0
"""Where the paper stops: the implicit scheme, 2,000 s of adaptation, measurement noise."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.simulation.metrics import rms
import numpy as np
from numpy.typing import NDArray
from studies.paper.cases import (
    CONVERGED,
    DEMO,
    FREQUENCIES,
    LEVANT,
    observe,
    SAFE,
    sampled,
    Score,
    score,
    truth_of,
)
from studies.paper.plant_and_observer import JointRun

Floats = NDArray[np.float64]

OBSERVERS: dict[str, tuple[str, dict[str, Any]]] = {
    'sign': ('sign', {}),
    'fuzzy': ('fuzzy', {}),
    'fuzzy adaptive': ('fuzzy_adaptive', {}),
    'sign adaptive': ('sign_adaptive', {}),
    'Levant sign': ('sign', LEVANT),
    'Levant fuzzy': ('fuzzy', LEVANT),
    'Levant fuzzy adaptive': ('fuzzy_adaptive', LEVANT),
}
"""What is sampled here: variant, and what differs from config/paper.yaml."""
NOISES = (1e-4, 1e-3, 1e-2)
"""Standard deviations of the noise on y; the amplitude of z1 is of order 0.1 to 1."""
LONG_DURATION = 2000.0
"""Seconds of a long run."""
WINDOW = 100.0
"""The drift of the long run is judged in windows of this many seconds."""
WORSE = 1.05
"""Adaptation may be this many times worse than none."""
LAWS: dict[str, dict[str, Any]] = {"the paper's": {}, 'default': SAFE}
"""Laws of gamma by name: what differs from config/paper.yaml."""
GAINS: dict[str, dict[str, Any]] = {'paper': {}, 'demo': DEMO}
"""Gains by the name of the configuration that they are from."""
LONG = (
    *(
        ('paper', scheme, omega, noise)
        for noise in (0.0, 1e-4)
        for scheme in ('explicit', 'implicit')
        for omega in FREQUENCIES
    ),
    *(('demo', 'implicit', omega, 0.0) for omega in FREQUENCIES),
)
"""Long runs: gains, scheme, angular frequency, noise on y."""
PROTECTIONS: dict[str, dict[str, Any]] = {
    "the paper's": {},
    'projection on [0.45, 1]': {'gamma_min': 0.45},
    'dead zone 0.1': {'gamma_dead_zone': 0.1},
    'leakage 0.05/s': {'gamma_leakage': 0.05},
    'default: dead zone and leakage': SAFE,
}
"""Each protection by itself, and the default settings."""
PROTECTED = tuple(
    ('paper', 'explicit', omega, noise) for omega, noise in ((1.0, 0.0), (5.0, 0.0), (1.0, 1e-3))
)
"""Runs in which the protections are compared; entries as in `LONG`."""
DEAD_ZONES = (0.003, 0.004, 0.005, SAFE['gamma_dead_zone'], 0.0075, 0.01)
SWEEP = (0.1, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0)
"""Angular frequencies at which the dead zones are compared."""
SWEEP_DURATION = 250.0
THINNED = 10
"""Long runs record every 10th sample."""


class Row(NamedTuple):
    """One cell of the table beyond the paper."""

    name: str
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
    law, gains, scheme, omega, noise : str, str, str, float, float
    t, rms_d, gamma : (K,) arrays
        End of each window, RMS error of d within it, gamma at its end.
    fixed : float
        RMS error of d of the same observer with gamma = 1/2, in the last window.

    """

    law: str
    gains: str
    scheme: str
    omega: float
    noise: float
    t: NDArray[np.float64]
    rms_d: NDArray[np.float64]
    gamma: NDArray[np.float64]
    fixed: float


def _row(name: str, scheme: str, step: float, omega: float, noise: float) -> Row:
    variant, changes = OBSERVERS[name]
    run = sampled(variant, omega, step, scheme, noise, **changes)
    return Row(name, scheme, step, omega, noise, score(run))


def shown() -> list[tuple[str, list[JointRun]]]:
    """Return the runs that a figure shows beside the paper's: a name, and one a frequency."""
    rows = [
        ('sign, implicit', 'sign', 'implicit', 1e-3, {}),
        ('sign, implicit', 'sign', 'implicit', 1e-2, {}),
        ('Levant sign, explicit', 'sign', 'explicit', 1e-3, LEVANT),
        ('Levant fuzzy, explicit', 'fuzzy', 'explicit', 1e-3, LEVANT),
    ]
    return [
        (f'{name}, {step:g} s', [sampled(v, w, step, s, **changes) for w in FREQUENCIES])
        for name, v, s, step, changes in rows
    ]


def schemes(tick: Callable[[], object]) -> list[Row]:
    """Measure sampled observers without noise: explicit at 1e-3 s, implicit at 1e-3 and 1e-2 s."""
    rows = []
    for scheme, step in (('explicit', 1e-3), ('implicit', 1e-3), ('implicit', 1e-2)):
        rows += [_row(name, scheme, step, w, 0.0) for w in FREQUENCIES for name in OBSERVERS]
        tick()
    return rows


def noises(tick: Callable[[], object]) -> list[Row]:
    """Measure sampled observers with noise on y, at 1e-3 s and the low frequency."""
    rows = []
    for noise in NOISES:
        for scheme in ('explicit', 'implicit'):
            rows += [_row(name, scheme, 1e-3, FREQUENCIES[0], noise) for name in OBSERVERS]
        tick()
    return rows


def long_runs(
    laws: Mapping[str, dict[str, Any]],
    gains: str,
    scheme: str,
    omega: float,
    noise: float,
    duration: float,
    window: float,
) -> list[LongRun]:
    """
    Adapt gamma by several laws for a long time; return its drift and the error of d.

    Parameters
    ----------
    gains : {'paper', 'demo'}
    duration, window : float
        Seconds from `CONVERGED` on, and length of the windows within which errors are judged.

    """
    truth = truth_of(omega, 1e-3, noise, duration + CONVERGED)
    row = THINNED * 1e-3
    first, size = round(CONVERGED / row), round(window / row)

    def windows(variant: str, changes: dict[str, Any]) -> tuple[Floats, Floats]:
        run = observe(truth, variant, scheme, THINNED, **(GAINS[gains] | changes))
        internal = GAINS[gains].get('estimate_from') == 'internal'
        estimate = run.z_tilde[:, -2] if internal else run.z_hat[:, -1]
        error = estimate - run.unknown_input
        starts = range(first, len(error) - size + 1, size)
        return (
            np.array([rms(error[k : k + size]) for k in starts]),
            np.array([run.gamma[k + size - 1] for k in starts]),
        )

    fixed = float(windows('fuzzy', {})[0][-1])
    runs = []
    for law, changes in laws.items():
        rms_d, gamma = windows('fuzzy_adaptive', changes)
        t = CONVERGED + window * np.arange(1, len(rms_d) + 1)
        runs.append(LongRun(law, gains, scheme, omega, noise, t, rms_d, gamma, fixed))
    return runs


def dead_zone_laws() -> dict[str, dict[str, Any]]:
    """Return the default law by its dead zone."""
    return {f'{zone:g}': SAFE | {'gamma_dead_zone': zone} for zone in DEAD_ZONES}


def dead_zones(
    frequencies: Sequence[float], duration: float, tick: Callable[[], object]
) -> list[LongRun]:
    """Return runs with the default law under both schemes; their `law` is the dead zone."""
    laws = dead_zone_laws()
    found: list[LongRun] = []
    for omega in frequencies:
        for scheme in ('explicit', 'implicit'):
            found += long_runs(laws, 'paper', scheme, omega, 0.0, duration, WINDOW)
        tick()
    return found
