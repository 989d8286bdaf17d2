# SPDX-License-Identifier: Apache-2.0
"""What a method of the comparison is, how it is scored, and how it is tuned."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core import ConfigurationError, Recording, TriangularModel
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.tuning.objective import SMALLEST
from fhaosmo_ros.tools.tuning.search import BAD, Dimension, minimise
import numpy as np
from studies.harness import Floats

JUDGED_FROM = 5.0  # seconds of each recording that are the transient
ROUNDING = 1e-15  # noise of a y about 1
DEADBEAT = 3.0  # bandwidth times period of an observer that forgets all but the last few samples
HOPELESS = 1.5
"""A trial this many times worse than the best one so far is not run on more recordings."""
Values = Mapping[str, Any]
Run = Callable[[Recording], Sequence[Floats]]
"""Estimates of z and d (K, n + 1) by readout: some have filtered states, and internal ones."""


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

    @property
    def speed(self) -> float:
        """Where searches begin: the bandwidth (rad/s) at which noise weighs as much as d."""
        fastest = 0.5 / self.period
        return fastest if self.noise <= 0.0 else min(self.balance(0), fastest)

    def balance(self, derivatives: int) -> float:
        """
        Return the bandwidth (rad/s) at which noise weighs as much as d, for N levels.

        Noise of density noise^2 period leaves noise sqrt(period w^(2 N - 1)) in the N-th level.
        Without any there is rounding.
        """
        levels = self.model.order + 1 + derivatives
        ratio = self.size / (max(self.noise, ROUNDING) * self.period**0.5)
        return float(min(ratio ** (1.0 / (levels - 0.5)), DEADBEAT / self.period))


class Search(NamedTuple):
    """What a method is tuned with."""

    judged: Callable[[Values], float]  # from values to the objective over all recordings
    setting: Setting
    recordings: Sequence[Recording]
    trials: int  # how often an objective may be evaluated
    seed: int


class Method(NamedTuple):
    """A way to estimate z and d."""

    name: str  # key in results, and head of its column
    kind: str  # one of `KINDS` in methods.py
    prepare: Callable[[Setting, Values], Run]
    """Raises ConfigurationError for values that make no observer."""
    space: Callable[[Setting], Sequence[Dimension]] = lambda _: ()
    """Parameters to tune for a setting."""
    tune: Callable[[Search], Values] | None = None  # A search of its own
    needs_noise: bool = False  # true for one that is about the noise, which there has to be


class Outcome(NamedTuple):
    """What a set of values brings."""

    value: float
    """Geometric mean of the objective over the recordings, guessed where not all were run."""
    readout: int  # the best one, which this is about
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
    best, averages, totals = 0, list[float](), defaultdict[int, float](float)
    try:
        run = method.prepare(setting, values)
    except ConfigurationError:  # values that make no observer, such as an unsolvable Riccati
        return Outcome(math.inf, best, averages, {})
    for count, recording in enumerate(recordings, 1):
        for readout, found in enumerate(run(recording)):
            error = objective(recording, found[:, -1], setting.judged_from)
            totals[readout] += math.log(max(error, SMALLEST))
        best = min(totals, key=totals.__getitem__)
        averages.append(math.exp(totals[best] / count))
        if not averages[-1] <= (HOPELESS * rival[count - 1] if rival else BAD):
            break
    value = averages[-1]
    if rival and len(averages) < len(recordings):  # as much worse on the others, it is assumed
        value *= rival[-1] / rival[len(averages) - 1]
    return Outcome(value, best, averages, dict(values))


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
        values = dict(method.tune(Search(judged, setting, recordings, trials, seed)))
    elif len(space) == 1:
        values = _scan(judged, space[0], trials)
    elif space:
        values = minimise(judged, space, trials, seed).best
    return trial(method, setting, values, recordings)


def _scan(judged: Callable[[Values], float], d: Dimension, trials: int) -> dict[str, float]:
    """Try points all over the range of the only parameter, then closer ones around the best."""
    coarse = max(1, 2 * trials // 3)
    points = [d.start, *np.geomspace(d.low, d.high, coarse)][:coarse]
    best = min(points, key=lambda x: judged({d.name: x}))
    step = (d.high / d.low) ** (1.0 / max(coarse - 1, 1))
    closer = np.geomspace(max(best / step, d.low), min(best * step, d.high), trials - coarse)
    return {d.name: float(min([best, *closer], key=lambda x: judged({d.name: x})))}
