# SPDX-License-Identifier: Apache-2.0
"""What a method of the comparison is, how it is scored, and how it is tuned."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.objective import SMALLEST
from fhaosmo_ros.tools.tuning.search import BAD, Dimension, minimise
import numpy as np
from studies.harness import Floats

JUDGED_FROM = 5.0
"""Seconds of each recording that are the transient."""
ROUNDING = 1e-15
"""Noise of a y about 1."""
DEADBEAT = 3.0
"""Bandwidth times period of an observer that forgets all but the last few samples."""
HOPELESS = 1.5
"""A trial this many times worse than the best one so far is not run on more recordings."""
LINEAR, USUAL, ROBUST = 'linear filter', 'usual Kalman filter', 'adaptive filter'
SLIDING, PAPER, OURS, SELF_TUNING = 'sliding mode', 'paper', 'ours, tuned', 'ours, self-tuning'
KINDS = (LINEAR, USUAL, ROBUST, SLIDING, PAPER, OURS, SELF_TUNING)
"""Kinds of methods; the usual Kalman filter, whose d is a random walk, is one of its own."""


class Estimates(NamedTuple):
    """Estimated states (K, n) and unknown input (K,), one row a sample."""

    z: Floats
    d: Floats


Values = Mapping[str, Any]
Run = Callable[[Recording], dict[str, Estimates]]
"""Estimates by readout: one method may offer several (filtered and internal states)."""


def objective(recording: Recording, estimates: Estimates, since: float = JUDGED_FROM) -> float:
    """Return the RMS error of d over the RMS of d; tuning minimises its geometric mean."""
    late = recording.t >= since
    d = recording.d[late]
    with np.errstate(over='ignore', invalid='ignore'):
        value = rms(estimates.d[late] - d) / rms(d)
    return value if np.isfinite(value) else float('inf')


def mean(errors: Iterable[float]) -> float:
    """Return the geometric mean: a tenth less counts the same on an easy case and a hard one."""
    return float(np.exp(np.mean(np.log(np.maximum(list(errors), SMALLEST)))))


class Setting(NamedTuple):
    """What a user knows before tuning."""

    model: TriangularModel
    period: float
    """Nominal sampling period in seconds."""
    size: float
    """About how large d is."""
    noise: float
    """Standard deviation of the noise on y, in its unit, with that of its rounding."""
    judged_from: float = JUDGED_FROM
    """Seconds of each recording that are the transient."""

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

    judged: Callable[[Values], float]
    """From values to the objective over all recordings."""
    setting: Setting
    recordings: Sequence[Recording]
    trials: int
    """How often an objective may be evaluated."""
    seed: int


class Method(NamedTuple):
    """A way to estimate z and d."""

    name: str
    """Key in results, and head of its column."""
    kind: str
    """One of `KINDS`."""
    space: Callable[[Setting], tuple[Dimension, ...]]
    """Parameters to tune for a setting; empty where none is."""
    prepare: Callable[[Setting, Values], Run]
    """Raises ConfigurationError for values that make no observer."""
    tune: Callable[[Search], Values] | None = None
    """A search of its own."""
    needs_noise: bool = False
    """True for one that is about the noise, which there has to be."""


def untuned(_: Setting) -> tuple[Dimension, ...]:
    """Return the space of a method that has no parameters."""
    return ()


class Tuned(NamedTuple):
    """A method's best values on the training recordings, and which of its readouts was best."""

    values: dict[str, Any]
    readout: str
    training: float


class Outcome(NamedTuple):
    """What one set of values brings."""

    value: float
    """Geometric mean of the objective over the recordings, guessed where not all were run."""
    readout: str
    """The best one, which this is about."""
    averages: list[float]
    """The same over the first recordings, so many as were run."""


def trial(
    method: Method, setting: Setting, values: Values, recordings: Sequence[Recording],
    rival: Sequence[float] = (),
) -> Outcome:  # fmt: skip
    """
    Evaluate a set of values on all recordings.

    It ends early where the average so far exceeds `HOPELESS` times that of the `rival`, the
    averages of the best set of values so far.
    """
    try:
        run = method.prepare(setting, values)
    except ConfigurationError:  # values that make no observer, such as an unsolvable Riccati
        return Outcome(float('inf'), '', [])
    totals: dict[str, float] = defaultdict(float)
    averages: list[float] = []
    for count, recording in enumerate(recordings, 1):
        for name, estimates in run(recording).items():
            totals[name] += math.log(
                max(objective(recording, estimates, setting.judged_from), SMALLEST)
            )
        best = min(totals, key=totals.__getitem__)
        averages.append(math.exp(totals[best] / count))
        if not averages[-1] <= (HOPELESS * rival[count - 1] if rival else BAD):
            break
    value = averages[-1]
    if rival and len(averages) < len(recordings):  # as much worse on the others, it is assumed
        value *= rival[-1] / rival[len(averages) - 1]
    return Outcome(value, best, averages)


def tune(
    method: Method, setting: Setting, recordings: Sequence[Recording], trials: int, seed: int
) -> Tuned:
    """Search a method's parameters; one without any is evaluated as it is."""
    space = list(method.space(setting))
    values: Values = {}
    best = Outcome(float('inf'), '', [])

    def judged(v: Values) -> float:
        nonlocal best
        found = trial(method, setting, v, recordings, best.averages)
        if len(found.averages) == len(recordings):
            best = min(best, found)
        return found.value

    if method.tune is not None:
        values = method.tune(Search(judged, setting, recordings, trials, seed))
    elif len(space) == 1:
        values = _scan(judged, space[0], trials)
    elif space:
        values = minimise(judged, space, trials, seed).best
    found = trial(method, setting, values, recordings)
    return Tuned(dict(values), found.readout or 'filtered', found.value)


def _scan(judged: Callable[[Values], float], d: Dimension, trials: int) -> dict[str, float]:
    """Try points all over the range of the only parameter, then closer ones around the best."""
    coarse = max(1, 2 * trials // 3)
    points = [d.start, *np.geomspace(d.low, d.high, coarse)][:coarse]
    best = min(points, key=lambda x: judged({d.name: x}))
    step = (d.high / d.low) ** (1.0 / max(coarse - 1, 1))
    closer = np.geomspace(max(best / step, d.low), min(best * step, d.high), trials - coarse)
    return {d.name: float(min([best, *closer], key=lambda x: judged({d.name: x})))}
