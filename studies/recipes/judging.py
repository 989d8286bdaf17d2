# SPDX-License-Identifier: Apache-2.0
"""Recordings with their truth, methods that have one number to choose, and who is better."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core import Family, OnlineEstimator, Trajectory
from fhaosmo_ros.core.parameters.files import load
import numpy as np
from numpy.typing import NDArray
from studies.model import model_alone, SELF_TUNING

CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'recipes'
OURS, FIXED = 'this observer, self-tuning', 'this observer, fixed gains'
BUTTERWORTH = {2: (np.sqrt(2.0), 1.0), 3: (2.0, 2.0, 1.0)}
"""Coefficients of Butterworth polynomials of degree N, without the first one."""
FAR = 1.0
"""Half-width of psi; smaller innovations are corrected linearly."""
Floats = NDArray[np.float64]


class Recorded(NamedTuple):
    """
    A recording with its truth.

    Attributes
    ----------
    name : str
    t : (N,) array
        Times (s).
    y, d : (N,) array
        Measured output, true unknown input.
    u : (N, m) array
        Known inputs, that of the interval which ends at each sample.
    judged : (N,) array of bool
        Samples that count.
    quantity : str
        What `d` holds and methods return, in a recipe that judges more than the unknown input.

    """

    name: str
    t: Floats
    y: Floats
    u: Floats
    d: Floats
    judged: NDArray[np.bool_]
    quantity: str = 'd'

    @property
    def period(self) -> float:
        """Median interval (s)."""
        return float(np.median(np.diff(self.t)))


class Fold(NamedTuple):
    """
    A model, the recordings on which peers are tuned, and those on which all are judged.

    Attributes
    ----------
    parameters : dict
        The model, as parameters of the estimator.
    training, judged : sequence of Recorded

    """

    parameters: dict[str, Any]
    training: Sequence[Recorded]
    judged: Sequence[Recorded]


Estimate = Callable[[Mapping[str, Any], Recorded, float], Floats]
"""From parameters, a recording and the number to choose to the estimates of d, (N,)."""


class Method(NamedTuple):
    """A method, the numbers from which the best is chosen with the truth, and their unit."""

    estimate: Estimate
    numbers: Sequence[float] = (0.0,)
    unit: str = 'rad/s'


def model(name: str, constants: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Return the model in config/recipes/`name`.yaml, with other constants."""
    p = load(CONFIG / f'{name}.yaml', 'estimator')
    return model_alone(p) | {f'constants.{k}': float(v) for k, v in (constants or {}).items()}


def run(parameters: Mapping[str, Any], r: Recorded) -> Trajectory:
    """Return what the node would have estimated."""
    stamps = 10**9 + np.round((r.t - r.t[0]) * 1e9).astype(np.int64)
    return OnlineEstimator(parameters).run(stamps, r.y, r.u if r.u.size else None)


def self_tuning(parameters: Mapping[str, Any], r: Recorded, _: float = 0.0) -> Floats:
    """Return d of the observer that is told only the model."""
    return run(dict(parameters) | SELF_TUNING, r).unknown_input


def fixed_gains(order: int, bandwidth: float, period: float) -> dict[str, Any]:
    """Return the gains of a linear observer with Butterworth poles at a bandwidth (rad/s)."""
    shape = BUTTERWORTH[order + 1]
    return {
        'structure': 'levant', 'scheme': 'predict_correct',
        'variant': 'fuzzy_adaptive', 'correction_period': period, 'fuzzy_widths': [FAR],
        'lambda': [float(c * bandwidth ** (k + 1) * FAR) for k, c in enumerate(shape)],
        'gamma_initial': 0.001, 'gamma_min': 0.0001, 'gamma_rate': 0.0, 'divergence_time': 0.5,
    }  # fmt: skip


def fixed(parameters: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return d of the observer with fixed gains of a bandwidth (rad/s)."""
    gains = fixed_gains(parameters['order'], bandwidth, r.period)
    return run(dict(parameters) | gains, r).unknown_input


def error(pairs: Sequence[tuple[Recorded, Floats]]) -> float:
    """Return the RMS error of estimates over the RMS of the truth, all recordings as one."""
    wrong = sum(float(np.sum((found - r.d)[r.judged] ** 2)) for r, found in pairs)
    size = sum(float(np.sum(r.d[r.judged] ** 2)) for r, _ in pairs)
    return float(np.sqrt(wrong / size))


def judge(methods: Mapping[str, Method], folds: Sequence[Fold]) -> dict[str, dict[str, Any]]:
    """
    Return the error of each method by name, in total and of each recording, and what was chosen.

    A method's number is the one with the least error on the training recordings of a fold.
    """
    found = {}
    for name, method in methods.items():
        pairs, chosen = [], []
        for p, training, judged in folds:
            best = method.numbers[0]
            if len(method.numbers) > 1:
                scores = {
                    number: error([(r, method.estimate(p, r, number)) for r in training])
                    for number in method.numbers
                }
                best = min(scores, key=scores.__getitem__)
            chosen.append(float(f'{best:.4g}'))
            pairs += [(r, method.estimate(p, r, best)) for r in judged]
        found[name] = {
            'error': float(f'{error(pairs):.4g}'),
            'recordings': {r.name: float(f'{error([(r, d)]):.4g}') for r, d in pairs},
            'chosen': chosen if len(method.numbers) > 1 else [],
            'unit': method.unit,
        }
    return found


def simulated(family: Mapping[str, Any], settled: float, count: int = 4) -> list[Recorded]:
    """Return recordings of the package's own simulation, for a run without foreign data."""
    found = []
    for k, r in enumerate(Family(family).recordings(count)):
        u = np.asarray(r.u, dtype=np.float64).reshape(len(r.t), -1)
        found.append(Recorded(f'simulated {k + 1}', r.t, r.y, u, r.d, r.t > settled))
    return found
