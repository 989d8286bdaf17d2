# SPDX-License-Identifier: Apache-2.0
"""
The observers that are compared, all with the same model and Phi; how they are scored and tuned.

Kalman filters with a steady gain:

    z_i' = z_{i+1} + Phi_i(z, u),   z_n' = Phi_n(z, u) + d
    d' = d_1 - decay d, d_1' = d_2 - decay d_1, ..., d_{m-1}' = -decay d_{m-1} + white noise
    x(t_k) = prediction(t_k) + K (y_k - prediction_1(t_k))

For a linear Phi the prediction equals the zero-order-hold discretisation, up to an error that
decreases with the longest step. Ours are as users get them: with the gains that `tune` finds by
its search, or self-tuning, in the online estimator.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stderr
from functools import partial
from io import StringIO
import math
from types import SimpleNamespace
from typing import Any, NamedTuple

from fhaosmo_ros.core import ConfigurationError, Recording, TriangularModel
from fhaosmo_ros.core.model.inputs import known_inputs
from fhaosmo_ros.core.model.prediction import Prediction
from fhaosmo_ros.core.observer.kalman import innovations
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.cli.command import shipped
from fhaosmo_ros.tools.tuning.identify import Samples
from fhaosmo_ros.tools.tuning.search import BAD, Dimension, minimise
from fhaosmo_ros.tools.tuning.tuner import DERIVATIVES, RATES, SMALLEST, TUNE_PARAMETERS, Tuner
import numpy as np
from scipy.linalg import solve_discrete_are
from studies import harness
from studies.harness import Floats

JUDGED_FROM = 5.0  # seconds of each recording that are the transient
ROUNDING = 1e-15  # noise of a y about 1
DEADBEAT = 3.0  # bandwidth times period of an observer that forgets all but the last few samples
HOPELESS = 1.5
"""A trial this many times worse than the best one so far is not run on more recordings."""
Values = Mapping[str, Any]
Run = Callable[[Recording], Floats]
"""From a recording to estimates of z and d, (K, n + 1)."""


def objective(recording: Recording, d: Floats, since: float = JUDGED_FROM) -> float:
    """Return the RMS error of d over the RMS of d; tuning minimises its geometric mean."""
    late = recording.t >= since
    truth = recording.d[late]
    with np.errstate(over='ignore', invalid='ignore'):
        value = rms(d[late] - truth) / rms(truth)
    return value if np.isfinite(value) else math.inf


def mean(errors: Iterable[float]) -> float:
    """Return the geometric mean: a tenth less counts the same on an easy case and a hard one."""
    return float(np.exp(np.mean(np.log(np.maximum(list(errors), SMALLEST)))))


class Setting(NamedTuple):
    """What a user knows before tuning."""

    model: TriangularModel
    period: float  # nominal sampling period in seconds
    size: float  # about how large d is
    noise: float  # standard deviation of the noise on y, in its unit, with that of its rounding
    judged_from: float = JUDGED_FROM  # seconds of each recording that are the transient

    @property
    def told(self) -> dict[str, Any]:
        """The model, as parameters of an estimator."""
        return {'order': self.model.order, 'phi': list(self.model.phi)}

    def balance(self, derivatives: int) -> float:
        """Return the bandwidth (rad/s) at which noise, or else rounding, weighs as much as d."""
        levels = self.model.order + 1 + derivatives
        # Noise of density noise^2 period leaves noise sqrt(period w^(2 N - 1)) in level N.
        ratio = self.size / (max(self.noise, ROUNDING) * self.period**0.5)
        return float(min(ratio ** (1.0 / (levels - 0.5)), DEADBEAT / self.period))


class Method(NamedTuple):
    """A way to estimate z and d."""

    name: str  # key in results, and head of its column
    kind: str  # one of `KINDS`
    prepare: Callable[[Setting, Values], Run]
    """Raises ConfigurationError for values that make no observer."""
    space: Callable[[Setting], Sequence[Dimension]] = lambda _: ()
    """Parameters to tune for a setting."""
    tune: Callable[..., Values] | None = None
    """A search of its own: from objective, setting, recordings, trials and seed."""


class Outcome(NamedTuple):
    """What a set of values brings."""

    value: float
    """Geometric mean of the objective over the recordings, guessed where not all were run."""
    averages: list[float]  # the same over the first recordings, so many as were run
    values: dict[str, Any]


def trial(
    method: Method, setting: Setting, values: Values, recordings: Sequence[Recording],
    rival: Sequence[float] = (),
) -> Outcome:  # fmt: skip
    """
    Evaluate a set of values on all recordings.

    It ends early where the average so far exceeds `HOPELESS` times that of the `rival`, the
    averages of the best set of values so far.
    """
    total, averages = 0.0, list[float]()
    try:
        run = method.prepare(setting, values)
    except ConfigurationError:  # values that make no observer, such as an unsolvable Riccati
        return Outcome(math.inf, averages, {})
    for count, recording in enumerate(recordings, 1):
        error = objective(recording, run(recording)[:, -1], setting.judged_from)
        total += math.log(max(error, SMALLEST))
        averages.append(math.exp(total / count))
        if not averages[-1] <= (HOPELESS * rival[count - 1] if rival else BAD):
            break
    value = averages[-1]
    if rival and len(averages) < len(recordings):  # as much worse on the others, it is assumed
        value *= rival[-1] / rival[len(averages) - 1]
    return Outcome(value, averages, dict(values))


def tune(
    method: Method, setting: Setting, recordings: Sequence[Recording], trials: int, seed: int
) -> Outcome:
    """Search a method's parameters; one without any is evaluated as it is."""
    averages: Sequence[float] = ()
    least = math.inf

    def judged(v: Values) -> float:
        nonlocal averages, least
        found = trial(method, setting, v, recordings, averages)
        if len(found.averages) == len(recordings) and found.value < least:
            averages, least = found.averages, found.value
        return found.value

    space, values = method.space(setting), {}
    if method.tune is not None:
        values = dict(method.tune(judged, setting, recordings, trials, seed))
    elif len(space) == 1:
        values = _scan(judged, space[0], trials)
    elif space:
        values = minimise(judged, space, trials, seed).best_params
    return trial(method, setting, values, recordings)


def _scan(judged: Callable[[Values], float], d: Dimension, trials: int) -> dict[str, float]:
    """Try points all over the range of the only parameter, then closer ones around the best."""
    coarse = max(1, 2 * trials // 3)
    points = [d.start, *np.geomspace(d.low, d.high, coarse)][:coarse]
    best = min(points, key=lambda x: judged({d.name: x}))
    step = (d.high / d.low) ** (1.0 / max(coarse - 1, 1))
    closer = np.geomspace(max(best / step, d.low), min(best * step, d.high), trials - coarse)
    return {d.name: float(min([best, *closer], key=lambda x: judged({d.name: x})))}


LINEAR, USUAL, ADAPTIVE = 'linear filter', 'usual Kalman filter', 'adaptive filter'
SLIDING, PAPER, OURS, SELF_TUNING = 'sliding mode', 'paper', 'ours, tuned', 'ours, self-tuning'
KINDS = (LINEAR, USUAL, ADAPTIVE, SLIDING, PAPER, OURS, SELF_TUNING)
"""Kinds of methods; the usual Kalman filter, whose d is a random walk, is one of its own."""
HUBER, NOISE, IMM = 'Kalman, Huber', 'Kalman, adaptive noise', 'IMM of three bandwidths'
EARLIER = {HUBER: ADAPTIVE, NOISE: ADAPTIVE, IMM: ADAPTIVE, 'Levant, implicit': SLIDING}
"""Methods of commit 1657d61 with their kinds: in our tables stays what they got."""
LINEAR_LIMIT = 'Kalman, Matern'  # our observer equals this filter for small innovations
REACH = 10.0  # how far a search for the bandwidth goes, as a factor to both sides
LONGEST, LONGEST_STEP = 1.5, 1.0
"""Steps of a prediction: nominal periods; seconds, for a model without dynamics of its own."""
GRID = len(DERIVATIVES) * len(RATES)  # trials that `tune` uses before its search


def steady_gain(
    model: TriangularModel, period: float, bandwidth: float, decay: float, derivatives: int
) -> Floats:
    """
    Return the gain K, (N,), of the filter that predicts to t_k and then corrects with y_k itself.

    The model is linearised at rest; behind it d and its derivatives decay at the rate `decay`
    (1/s), 0 for a random walk, and white noise drives the last of them, as intense as makes
    `bandwidth` (rad/s) about that of the filter. States are scaled by powers of the period (s),
    because the Riccati equation is badly conditioned otherwise.
    """
    n, size = model.order, model.order + 1 + derivatives
    rates = np.eye(size, k=1)
    rates[range(n, size), range(n, size)] = -decay
    rates[:n, :n] += model.jacobian(np.zeros(n))
    scale = period ** np.arange(size)  # scaled states are x_i * period^(i - 1)
    a, noise = harness.discretised(rates * scale[:, None] / scale[None, :], size - 1, period)
    intensity = period * bandwidth ** (2 * size)  # for noise of variance 1 on y
    noise = 0.5 * intensity * scale[-1] ** 2 * (noise + noise.T)
    try:
        with np.errstate(invalid='ignore'):  # the result is checked below
            p = solve_discrete_are(a.T, np.eye(size)[:1].T, noise, np.eye(1))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ConfigurationError(f'Kalman gain: no solution ({error})') from None
    gain = p[:, 0] / (p[0, 0] + 1.0) / scale
    if not np.isfinite(gain).all():
        raise ConfigurationError(f'Kalman gain: expected finite numbers, got {gain}')
    return gain


def _steady(setting: Setting, values: Values) -> Run:
    """
    Return a run of the filter whose speed is about `bandwidth`.

    It takes samples as if each came one period after the one before; its covariance P is as it has
    to be for the gain from the beginning, and stays.
    """
    model, period, decay = setting.model, setting.period, values.get('decay', 0.0)
    n, derivatives = model.order, int(values.get('derivatives', 0))
    gain = steady_gain(model, period, values['bandwidth'], decay, derivatives)
    size, expressions = len(gain), model.with_unknown_input(decay, derivatives)
    fresh = np.zeros((size, size))
    fresh[:, 0] = gain  # K = P_1 / (P_11 + variance)
    steady = SimpleNamespace(
        a=np.eye(size), q=np.zeros((size, size)), fresh=fresh, variance=1.0 - gain[0],
        clip=math.inf, settled=0,
    )  # fmt: skip
    # Runge-Kutta steps (s) up to this one have a negligible error. For a linear model steps of
    # 0.1 / fastest rate would do; a nonlinearity that is crossed within a few steps, such as dry
    # friction, needs shorter ones.
    rates = model.jacobian(np.zeros(n)) + np.eye(n, k=1)
    fastest = float(np.max(np.abs(np.linalg.eigvals(rates))))
    longest = min(LONGEST * period, 0.03 / max(fastest, 1e-9), LONGEST_STEP)

    def run(r: Recording) -> Floats:
        count = len(r.y)
        periods, used = np.ones(count, np.int64), np.ones(count, np.bool_)
        periods[0] = 0  # there the filter begins
        u, h = known_inputs(r.u, model.inputs, count), np.diff(r.t, prepend=r.t[0])
        samples = Samples(h, periods, np.ascontiguousarray(r.y), u, used)
        return innovations(Prediction(expressions, longest), samples, steady)[2][:, : n + 1]

    return run


def matern_space(setting: Setting, derivatives: int = 0) -> tuple[Dimension, ...]:
    """Return bandwidth and decay of a filter whose d is a Matern process."""
    speed, fastest = setting.balance(derivatives), 5.0 / setting.period
    return (
        Dimension('bandwidth', speed / REACH, min(speed * REACH, fastest), speed),
        Dimension('decay', 0.03, 30.0, 1.0),
    )


def each_order(
    judged: Callable[[Values], float], setting: Setting, _: object, trials: int, seed: int
) -> Values:
    """Search bandwidth and decay with each number of derivatives of d."""
    best: tuple[float, Values] = (math.inf, {})
    for k in DERIVATIVES:
        fixed = {'derivatives': float(k)}
        found = minimise(
            lambda v, fixed=fixed: judged(fixed | v),
            matern_space(setting, k),
            max(1, trials // len(DERIVATIVES)),
            seed,
        )
        if not best[1] or found.best_value < best[0]:
            best = found.best_value, fixed | found.best_params
    return best[1]


def _online(own: Values, setting: Setting, values: Values) -> Run:
    """Return a run of the online estimator with these parameters."""
    parameters = setting.told | dict(values) | dict(own)

    def estimate(r: Recording) -> Floats:
        found = harness.observed(parameters, r)
        return np.column_stack([found.z, found.unknown_input])

    return estimate


def _papers(variant: str) -> dict[str, Any]:
    """Return the paper's numbers that fit any plant: all but the model and the initial values."""
    values = load(shipped('config/paper.yaml'), 'estimator', OBSERVER_PARAMETERS)
    own = ('order', 'phi', 'initial_estimate', 'initial_internal', 'start_from_measurement')
    kept = {name: values[name] for name in values if name not in own}
    return kept | {name: kept[name][:1] for name in ('lambda', 'alpha')} | {'variant': variant}


def _tune(
    _: object, setting: Setting, recordings: Sequence[Recording], trials: int, seed: int
) -> Values:
    """Return the parameters of the estimator that `tune` writes; its grid uses trials, too."""
    tuning = TUNE_PARAMETERS.complete(setting.told | {'settled': JUDGED_FROM})
    with redirect_stderr(StringIO()):  # its progress bars
        tuner = Tuner(list(recordings), {}, tuning, seed)
        return tuner.parameters(tuner.search(max(1, trials - GRID)).best_params)


def _one_bandwidth(s: Setting) -> Sequence[Dimension]:
    """Return a range in rad/s, from far below any d to where the observer is deadbeat."""
    return [Dimension('bandwidth', 0.05, 5.0 / s.period, min(s.balance(0), 0.5 / s.period))]


PAPERS = {'sign': 'sign', 'fuzzy': 'fuzzy', 'adaptive': 'fuzzy_adaptive'}
METHODS = {
    m.name: m
    for m in (
        Method('Kalman', USUAL, _steady, _one_bandwidth),  # d a random walk
        Method('Kalman, decaying', LINEAR, _steady, matern_space),  # a random walk that decays
        Method(LINEAR_LIMIT, LINEAR, _steady, matern_space, each_order),
        *(
            Method(f'paper: {name}', PAPER, partial(_online, _papers(variant)))
            for name, variant in PAPERS.items()
        ),
        Method(OURS, OURS, partial(_online, {}), tune=_tune),  # levant, fuzzy, predict_correct
        Method(SELF_TUNING, SELF_TUNING, partial(_online, harness.SELF_TUNING)),
    )
}
"""The observers, by name."""
