# SPDX-License-Identifier: Apache-2.0
"""Recordings with their truth, methods that have one number to choose, and who is better."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core import Trajectory, TriangularModel
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import numpy as np
from numpy.typing import NDArray
from studies.evidence import Row
from studies.harness import Floats, model_alone, observed, SELF_TUNING

CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'recipes'
OURS, FIXED = 'this observer, self-tuning', 'this observer, fixed gains'
BUTTERWORTH = {2: (np.sqrt(2.0), 1.0), 3: (2.0, 2.0, 1.0)}
"""Coefficients of Butterworth polynomials of degree N, without the first one."""
FAR = 1.0
"""Half-width of psi; smaller innovations are corrected linearly."""


class Recorded(NamedTuple):
    """A recording with its truth, (N,) arrays but for u."""

    name: str
    t: Floats
    """Seconds."""
    y: Floats
    u: Floats
    """(N, m): known inputs, that of the interval which ends at each sample."""
    d: Floats
    """The true unknown input, or the `quantity` that methods return in its place."""
    settled: float
    """Seconds after which errors count."""
    quantity: str = 'd'

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Samples that count."""
        return self.t - self.t[0] > self.settled

    @property
    def period(self) -> float:
        """Median interval (s)."""
        return float(np.median(np.diff(self.t)))


class Fold(NamedTuple):
    """A model as parameters, the recordings that tune the peers, and those that judge all."""

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


Folds = Mapping[str, Sequence[Fold]]
"""By condition."""
Judgements = Mapping[str, Mapping[str, Row]]
"""Error, chosen numbers (one a fold) and their unit, by condition and method."""


class Recipe(NamedTuple):
    """What is measured and how it is shown."""

    methods: dict[str, Method]
    conditions: Callable[[Any], Folds]
    """From the recordings' path, None where the recipe needs no recordings."""
    quantity: str
    """What the figure shows, with its unit."""
    drawn: Sequence[str]
    """Methods in the figure."""
    shown: tuple[float, float]
    """Seconds in the figure."""
    scale: float = 1.0
    """From d to the quantity."""
    fold: int = 0
    """The fold in the figure."""
    band: bool = True
    """Whether it has the standard deviations."""
    data: str = ''
    """The recordings that have to be given."""


def model(name: str, constants: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Return the model in config/recipes/`name`.yaml, with other constants."""
    p = load(CONFIG / f'{name}.yaml', 'estimator')
    return model_alone(p) | {f'constants.{k}': float(v) for k, v in (constants or {}).items()}


def plant_of(parameters: Mapping[str, Any]) -> TriangularModel:
    """Return the model that the estimator's parameters describe."""
    return TriangularModel.of(ESTIMATOR_PARAMETERS.complete(parameters))


def run(parameters: Mapping[str, Any], r: Recorded) -> Trajectory:
    """Return what the node would have estimated."""
    return observed(parameters, r.t, r.y, r.u if r.u.size else None)


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


def error(pairs: Iterable[tuple[Recorded, Floats]]) -> float:
    """Return the RMS error of estimates over the RMS of the truth, all recordings as one."""
    both = [((found - r.d)[r.judged], r.d[r.judged]) for r, found in pairs]
    wrong, size = (sum(float(np.sum(x**2)) for x in column) for column in zip(*both, strict=True))
    return float(np.sqrt(wrong / size))


def judge(method: Method, folds: Sequence[Fold]) -> Row:
    """
    Return the error of a method over all recordings, and what was chosen.

    Its number is the one with the least error on the training recordings of a fold.
    """
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
    wrong, unit = float(f'{error(pairs):.4g}'), method.unit if chosen else ''
    return {'error': wrong, 'chosen': ' '.join(f'{x:g}' for x in chosen), 'unit': unit}
