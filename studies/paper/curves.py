# SPDX-License-Identifier: Apache-2.0
"""What the shape of the fuzzy curves changes, everything else being the same."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from fhaosmo_ros.core import Family, Observer, Plant
from fhaosmo_ros.core.observer.fuzzy import curves, KNOTS, of_level
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.cli.share import shipped
import numpy as np
from studies.paper.cases import Floats, preset

DURATION = 40.0
"""Seconds; the second half is judged."""
SIGMA = 1e-3
"""Standard deviation of the noise, where there is some."""
NARROW = 8.0
"""Half-width of the straight line in `SIGMA`, with the gains of config/noise_1e-3.yaml."""
DEFAULT = 'triangles'
SYSTEMS: dict[str, Any] = {
    DEFAULT: OBSERVER_PARAMETERS['fuzzy_systems'].default,
    'bells': ['terms gaussian 5', 'terms gaussian 7'],
    'straight line': ['terms 5; output singleton 5'],
}
"""Fuzzy systems by name."""
PLANTS: dict[str, dict[str, Any]] = {
    'sine, ω = 1': {},
    'sine, ω = 5': {'disturbance_omega': 5.0},
    'sine, ω = 1, noise 0.001': {'noise_std': SIGMA},
    'square, ω = 1': {'disturbance': 'square'},
}
RANDOM: dict[str, dict[str, Any]] = {
    'random, noise 0.001': {},
    'the same, 1 % outliers of 50 σ': {'outliers': 0.01, 'outlier_std': 50.0 * SIGMA},
}
CELLS = (
    *(('paper', signal) for signal in PLANTS),
    *(('default', signal) for signal in PLANTS),
    *(('noise_1e-3, narrow', signal) for signal in RANDOM),
)
"""Gains, and what d and the noise do, in words."""


class CurveRow(NamedTuple):
    """RMS errors of d with each of `SYSTEMS`, in one of `CELLS`."""

    gains: str
    signal: str
    rms_d: list[float]


def compare(tick: Callable[[], object]) -> list[CurveRow]:
    """
    Measure the error of d with each system.

    Half-widths are scaled so that all curves have the same slope at 0: otherwise the gain for
    small innovations, not the shape, would make the difference.
    """
    rows = []
    for gains, signal in CELLS:
        (t, y, d), base, errors = _signal(signal), _gains(gains), []
        for name, texts in SYSTEMS.items():
            widths = [of_level(base['fuzzy_widths'], i) for i in range(4)]
            widths = (widths * slopes(name) / slopes(DEFAULT)).tolist()
            observer = Observer(base | {'fuzzy_systems': texts, 'fuzzy_widths': widths})
            error = observer.run(t, y).unknown_input - d
            errors.append(rms(error[t >= 0.5 * DURATION]))
        rows.append(CurveRow(gains, signal, errors))
        tick()
    return rows


@cache
def slopes(name: str) -> Floats:
    """Return the slopes at 0 of the curves of levels 1 to 4, for a half-width of 1."""
    parameters = OBSERVER_PARAMETERS.defaults() | {'fuzzy_systems': SYSTEMS[name]}
    first = curves(parameters, 4)[:, 1]
    return first * (KNOTS - 1)


def _gains(name: str) -> dict[str, Any]:
    if name == 'paper':
        return dict(preset().observer)
    p = OBSERVER_PARAMETERS.defaults()
    if name != 'default':
        p |= load(shipped('config/noise_1e-3.yaml'), 'estimator', OBSERVER_PARAMETERS)
        widths = NARROW * SIGMA * slopes(DEFAULT)
        p['lambda'] = (p['lambda'] * widths / p['fuzzy_widths']).tolist()  # as tuned, near 0
        p['fuzzy_widths'] = widths.tolist()
    return p


def _signal(name: str) -> tuple[Floats, Floats, Floats]:
    """Return t, y and d."""
    if name in RANDOM:
        family = Family({'duration': DURATION, 'noise_std': SIGMA} | RANDOM[name])
        recording = family.recording(0)
        return recording.t, recording.y, recording.d
    t = np.arange(round(DURATION / 1e-3) + 1) * 1e-3
    truth = Plant({'integration_step': 1e-3} | PLANTS[name]).simulate(t)
    return t, truth.y, truth.unknown_input
