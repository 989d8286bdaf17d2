# SPDX-License-Identifier: Apache-2.0
"""
Recordings with their truth, methods, and who is better.

Methods have one number to choose: those that people use today its bandwidth (rad/s).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core import TriangularModel
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.tuning.linear_gains import SCHEME
import numpy as np
from numpy.typing import NDArray
from scipy.signal import bilinear, lfilter
from studies.evidence import Row
from studies.harness import Floats, model_alone, observed, SELF_TUNING

CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'recipes'
VELOCITY = 'velocity'  # a `quantity`
OURS, FIXED = 'this observer, self-tuning', 'this observer, fixed gains'
BUTTERWORTH = {2: (np.sqrt(2.0), 1.0), 3: (2.0, 2.0, 1.0)}  # polynomials, but their first 1
FAR = 1.0  # half-width of psi; smaller innovations are corrected linearly


class Recorded(NamedTuple):
    """A recording with its truth, (N,) arrays but for u."""

    name: str
    t: Floats  # s
    y: Floats
    u: Floats  # (N, m): known inputs of the interval which ends at each sample; one of 0 for none
    d: Floats  # the true unknown input, or the `quantity` that methods return in its place
    settled: float  # seconds after which errors count
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


Folds = Mapping[str, Sequence[Fold]]  # by condition


class Recipe(NamedTuple):
    """What is measured and how it is shown."""

    methods: dict[str, Method]
    conditions: Callable[[Any], Folds]  # from the path of recordings, None where none are needed
    quantity: str  # in the figure, with its unit
    drawn: Sequence[str]  # methods in the figure
    shown: tuple[float, float]  # seconds in the figure
    scale: float = 1.0  # from d to the quantity
    fold: int = 0  # in the figure
    band: bool = True  # whether the figure has the standard deviations
    data: str = ''  # the recordings that have to be given


def model(name: str, constants: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Return the model in config/recipes/`name`.yaml, with other constants."""
    p = load(CONFIG / f'{name}.yaml', 'estimator')
    return model_alone(p) | {f'constants.{k}': float(v) for k, v in (constants or {}).items()}


def fixed_gains(order: int, bandwidth: float, period: float) -> dict[str, Any]:
    """Return the gains of a linear observer with Butterworth poles at a bandwidth (rad/s)."""
    shape = BUTTERWORTH[order + 1]
    return {
        **SCHEME, 'correction_period': period, 'fuzzy_widths': [FAR],
        'lambda': [float(c * bandwidth ** (k + 1) * FAR) for k, c in enumerate(shape)],
        'gamma_initial': 0.001, 'divergence_time': 0.5,
    }  # fmt: skip


def this_observer(parameters: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return z2 or d of the observer with gains of a bandwidth (rad/s); 0: self-tuning."""
    gains: dict[str, Any] = SELF_TUNING
    if bandwidth:
        gains = fixed_gains(parameters['order'], bandwidth, r.period)
    found = observed(dict(parameters) | gains, r)
    return found.z[:, 1] if r.quantity == VELOCITY else found.unknown_input


def low_passed(x: Floats, bandwidth: float, period: float, order: int, derivative: int) -> Floats:
    """Return a derivative of x behind (s / bandwidth + 1)^-order, from rest at the first value."""
    denominator = np.poly([-bandwidth] * order) / bandwidth**order
    b, a = bilinear([1.0] + [0.0] * derivative, denominator, 1.0 / period)
    return lfilter(b, a, x - x[0]) + (x[0] if derivative == 0 else 0.0)


def disturbance_observer(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """
    Return d = Q(s) (s² y - Phi_2), Q = (s / bandwidth + 1)^-2, for a model of order 2.

    The low-passed second derivative less what the model explains (Chen et al. 2016,
    doi:10.1109/TIE.2015.2478397).
    """
    model, h = TriangularModel.of(ESTIMATOR_PARAMETERS.complete(p)), r.period
    velocity = low_passed(r.y, bandwidth, h, 2, 1)
    samples = zip(np.column_stack([r.y, velocity]), r.u, strict=True)
    explained = np.array([model.evaluate(z, u)[1] for z, u in samples])
    acceleration = low_passed(r.y, bandwidth, h, 2, 2)
    return acceleration - low_passed(explained, bandwidth, h, 2, 0)


def kalman_filter(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """
    Return d of an extended Kalman filter whose model of d is a random walk.

    Only the ratio of the two noises matters; it is given as the bandwidth of the steady filter of
    the chain of integrators: q = bandwidth^(2N) noise² h, N = n + 1.
    """
    model = TriangularModel.of(ESTIMATOR_PARAMETERS.complete(p))
    n, h = model.order, r.period
    q = bandwidth ** (2 * n + 2) * h
    x = np.zeros(n + 1)
    x[0] = r.y[0]
    covariance = np.diag([(3.0 * bandwidth) ** (2 * k) for k in range(n + 1)])
    chain, found = np.eye(n + 1, k=1), np.zeros(len(r.y))
    for k in range(1, len(r.y)):
        dt, u = r.t[k] - r.t[k - 1], r.u[k]
        rates = [np.zeros(n + 1)]
        for share in (0.0, 0.5, 0.5, 1.0):
            point = x + share * dt * rates[-1]
            rate = chain @ point
            rate[:n] += model.evaluate(point[:n], u)
            rates.append(rate)
        x = x + dt / 6.0 * (rates[1] + 2.0 * rates[2] + 2.0 * rates[3] + rates[4])
        slopes = chain.copy()
        slopes[:n, :n] += model.jacobian(x[:n], u)
        a = last = np.eye(n + 1)
        for power in range(1, 5):
            last = last @ slopes * (dt / power)
            a = a + last
        covariance = a @ covariance @ a.T
        covariance[n, n] += q * dt
        gain = covariance[:, 0] / (covariance[0, 0] + 1.0)
        x = x + gain * (r.y[k] - x[0])
        covariance = covariance - np.outer(gain, covariance[0])
        found[k] = x[n]
    return found


def error(pairs: Iterable[tuple[Recorded, Floats]]) -> float:
    """Return the RMS error of estimates over the RMS of the truth, all recordings as one."""
    both = [((found - r.d)[r.judged], r.d[r.judged]) for r, found in pairs]
    wrong, size = (sum(float(np.sum(x**2)) for x in column) for column in zip(*both, strict=True))
    return float(np.sqrt(wrong / size))


def judge(method: Method, folds: Sequence[Fold]) -> Row:
    """Return a method's error over all recordings; its numbers are those best in training."""
    pairs, chosen = [], []
    for p, training, judged in folds:
        best = method.numbers[0]
        if len(method.numbers) > 1:
            best = min(
                method.numbers,
                key=lambda x, p=p, rs=training: error((r, method.estimate(p, r, x)) for r in rs),
            )
            chosen.append(f'{float(f"{best:.4g}"):g}')
        pairs += [(r, method.estimate(p, r, best)) for r in judged]
    wrong, unit = float(f'{error(pairs):.4g}'), method.unit if chosen else ''
    return {'error': wrong, 'chosen': ' '.join(chosen), 'unit': unit}
