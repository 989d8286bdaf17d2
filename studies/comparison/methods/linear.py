# SPDX-License-Identifier: Apache-2.0
"""
The linear peers: constant gains, the same model and Phi as ours.

    z_i' = z_{i+1} + Phi_i(z, u),   z_n' = Phi_n(z, u) + d
    d' = d_1 - decay d, d_1' = d_2 - decay d_1, ..., d_{m-1}' = -decay d_{m-1}
    x(t_k) = prediction(t_k) + K (y_k - prediction_1(t_k))

For a linear Phi the prediction equals the zero-order-hold discretisation, up to an error that
decreases with the longest step.

The extended state observer (ESO): J. Han, IEEE Transactions on Industrial Electronics 56(3), 2009,
doi:10.1109/TIE.2008.2011621.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
import math
from types import SimpleNamespace

from fhaosmo_ros.core.model.inputs import known_inputs
from fhaosmo_ros.core.model.prediction import Prediction
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.kalman import innovations
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.likelihood import Samples
from fhaosmo_ros.tools.tuning.search import Dimension, minimise
import numpy as np
from studies.comparison.methods.method import (
    Estimates,
    LINEAR,
    Method,
    Run,
    Search,
    Setting,
    USUAL,
    Values,
)
from studies.comparison.methods.sampled import SampledModel

LINEAR_LIMIT = 'Kalman, Matern'
"""Our observer equals this filter for small innovations."""
REACH = 10.0
"""How far a search for the bandwidth goes, as a factor to both sides."""
LONGEST = 1.5
"""Nominal periods that one step of a prediction may take."""
DERIVATIVES = (0, 1, 2, 3)
"""Of d, that are tried."""
Gain = Callable[[SampledModel, Values], np.ndarray]
Space = Callable[[Setting], tuple[Dimension, ...]]


def samples_of(r: Recording, model: TriangularModel) -> Samples:
    """Return the samples of a recording, as if each came one period after the one before."""
    count = len(r.y)
    periods, used = np.ones(count, np.int64), np.ones(count, np.bool_)
    periods[0] = 0  # there a filter begins
    u = known_inputs(r.u, model.inputs, count)
    return Samples(np.diff(r.t, prepend=r.t[0]), periods, np.ascontiguousarray(r.y), u, used)


def estimates(
    model: TriangularModel, gain: np.ndarray, decay: float, r: Recording, longest: float
) -> np.ndarray:
    """
    Return the estimates of z, d, d_1, .. of a recording, a row for each sample, by the gain K.

    `decay` is 0 for a random walk; intervals beyond `longest` (s) take several steps. This is a
    Kalman filter whose covariance P is as it has to be for K from the beginning, and stays.
    """
    expressions, size = model.with_unknown_input(decay, len(gain) - model.order - 1), len(gain)
    fresh = np.zeros((size, size))
    fresh[:, 0] = gain  # K = P_1 / (P_11 + variance)
    steady = SimpleNamespace(
        a=np.eye(size), q=np.zeros((size, size)), fresh=fresh, variance=1.0 - gain[0],
        clip=math.inf, settled=0,
    )  # fmt: skip
    _, _, found = innovations(Prediction(expressions, longest), samples_of(r, model), steady)
    return np.asarray(found)


@lru_cache(maxsize=64)
def _sampled(
    phi: tuple[str, ...], period: float, chain: int, integrators_only: bool, decay: float
) -> SampledModel:
    return SampledModel(TriangularModel(phi), period, chain, integrators_only, decay)


def _run(
    gain: Gain, shortest: int, integrators_only: bool, setting: Setting, values: Values
) -> Run:
    model, chain = setting.model, shortest + int(values.get('derivatives', 0))
    decay = values.get('decay', 0.0)
    sampled = _sampled(model.phi, setting.period, chain, integrators_only, decay)
    k = gain(sampled, values)
    n, longest = model.order, min(LONGEST * setting.period, sampled.resolution)

    def estimate(r: Recording) -> dict[str, Estimates]:
        out = estimates(model, k, decay, r, longest)
        return {'filtered': Estimates(out[:, :n], out[:, n])}

    return estimate


def _kalman(model: SampledModel, values: Values) -> np.ndarray:
    """Intensity of d's random walk such that the filter's speed is about `bandwidth`."""
    return model.kalman([model.period * values['bandwidth'] ** (2 * model.size)])


def _kalman_ramp(model: SampledModel, values: Values) -> np.ndarray:
    drift = model.period * values['drift_bandwidth'] ** (2 * model.size)
    walk = model.period * values['bandwidth'] ** (2 * model.size - 2)
    return model.kalman([drift, walk])


def placed(model: SampledModel, poles: Sequence[complex]) -> np.ndarray:
    """
    Return the gain that places the poles of the error dynamics here in the s plane.

    By Ackermann's formula, since poles may coincide. Slow poles lie so close to 1 in the z plane
    that a placement of z fails: (z - 1) / period is placed, with time in units of the mean pole.
    """
    speed, size = math.exp(float(np.mean(np.log(np.abs(poles))))), model.size
    scale = speed ** -np.arange(float(size))
    difference = model.a / model.scale[:, None] * model.scale[None, :] - np.eye(size)
    rates = difference * scale[:, None] / scale[None, :] / (model.period * speed)
    seen = rates[0] * (model.period * speed) + np.eye(size)[0]  # y after the prediction
    places = [np.expm1(pole * model.period) / (model.period * speed) for pole in poles]
    observed = np.array([seen @ np.linalg.matrix_power(rates, i) for i in range(size)])
    polynomial = np.zeros((size, size))
    for coefficient in np.real(np.poly(places)):
        polynomial = polynomial @ rates + coefficient * np.eye(size)
    try:
        gain = polynomial @ np.linalg.solve(observed, np.eye(size)[-1])
    except np.linalg.LinAlgError as error:
        raise ConfigurationError(f'pole placement: no solution ({error})') from None
    if not np.isfinite(gain).all():
        raise ConfigurationError('gain: expected finite numbers, got some that are not')
    return gain * model.period * speed / scale


def pair(frequency: float, damping: float) -> list[complex]:
    """Return the poles of s^2 + 2 damping frequency s + frequency^2."""
    if damping < 1.0:
        imaginary = frequency * math.sqrt(1.0 - damping * damping)
        return [complex(-damping * frequency, sign * imaginary) for sign in (1.0, -1.0)]
    root = frequency * math.sqrt(damping * damping - 1.0)
    return [complex(-damping * frequency + sign * root) for sign in (1.0, -1.0)]


def _eso(model: SampledModel, values: Values) -> np.ndarray:
    return placed(model, [complex(-values['bandwidth'])] * model.size)


def _luenberger(model: SampledModel, values: Values) -> np.ndarray:
    poles: list[complex] = []
    for i in range(model.size // 2):
        poles += pair(values[f'frequency_{i + 1}'], values[f'damping_{i + 1}'])
    if model.size % 2:
        poles.append(complex(-values['real_pole']))
    return placed(model, poles)


def _bandwidth(name: str, setting: Setting) -> Dimension:
    """Return a range in rad/s, from far below any d to where the observer is deadbeat."""
    return Dimension(name, 0.05, 5.0 / setting.period, setting.speed)


def _one_bandwidth(setting: Setting) -> tuple[Dimension, ...]:
    return (_bandwidth('bandwidth', setting),)


def _two_bandwidths(setting: Setting) -> tuple[Dimension, ...]:
    return (*_one_bandwidth(setting), _bandwidth('drift_bandwidth', setting))


def _luenberger_space(setting: Setting) -> tuple[Dimension, ...]:
    pairs, odd = divmod(setting.model.order + 1, 2)
    space = []
    for i in range(1, pairs + 1):
        space.append(_bandwidth(f'frequency_{i}', setting))
        space.append(Dimension(f'damping_{i}', 0.1, 5.0, 0.7))
    return (*space, *[_bandwidth('real_pole', setting)] * odd)


def matern_space(setting: Setting, derivatives: int = 0) -> tuple[Dimension, ...]:
    """Return bandwidth and decay of a filter whose d is a Matern process."""
    speed, fastest = setting.balance(derivatives), 5.0 / setting.period
    return (
        Dimension('bandwidth', speed / REACH, min(speed * REACH, fastest), speed),
        Dimension('decay', 0.03, 30.0, 1.0),
    )


def each_order(search: Search, more: Sequence[Dimension] = ()) -> Values:
    """Search bandwidth, decay and `more` with each number of derivatives of d."""
    best: tuple[float, Values] = (float('inf'), {})
    for k in DERIVATIVES:
        fixed = {'derivatives': float(k)}
        found = minimise(
            lambda v, fixed=fixed: search.judged(fixed | v),
            (*matern_space(search.setting, k), *more),
            max(1, search.trials // len(DERIVATIVES)),
            search.seed,
            jobs=1,
        )
        if not best[1] or found.value < best[0]:
            best = found.value, fixed | found.best
    return best[1]


def _method(
    name: str, kind: str, space: Space, gain: Gain, shortest: int = 1,
    integrators_only: bool = False, tune: Callable[[Search], Values] | None = None,
) -> Method:  # fmt: skip
    return Method(name, kind, space, partial(_run, gain, shortest, integrators_only), tune)


FILTERS = (
    _method('Kalman', USUAL, _one_bandwidth, _kalman),  # d a random walk
    _method('Kalman, ramp', LINEAR, _two_bandwidths, _kalman_ramp, shortest=2),  # its rate, too
    _method('Kalman, decaying', LINEAR, matern_space, _kalman),  # a random walk that decays
    _method(LINEAR_LIMIT, LINEAR, matern_space, _kalman, tune=each_order),
    _method('ESO', LINEAR, _one_bandwidth, _eso, integrators_only=True),  # all poles at one place
    _method('Luenberger', LINEAR, _luenberger_space, _luenberger),  # all poles free
)
"""Steady-state Kalman filters by their d, an extended state observer, a Luenberger observer."""
