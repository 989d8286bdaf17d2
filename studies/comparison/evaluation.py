# SPDX-License-Identifier: Apache-2.0
"""Tune a method for a sensor, and judge it on what the tuning has not seen."""

from collections import defaultdict
from collections.abc import Callable, Sequence
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.objective import SMALLEST
from fhaosmo_ros.tools.tuning.search import BAD, Dimension, minimise
import numpy as np
from studies.comparison.cells import Sensor
from studies.comparison.methods.adaptive import ADAPTIVE
from studies.comparison.methods.linear import FILTERS
from studies.comparison.methods.method import mean, Method, objective, Search, Setting, Values
from studies.comparison.methods.observers import OBSERVERS

HOPELESS = 1.5
"""A trial this many times worse than the best one so far is not run on more recordings."""
METHODS: dict[str, Method] = {m.name: m for m in (*FILTERS, *ADAPTIVE, *OBSERVERS)}


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
            totals[name] += math.log(max(objective(recording, estimates), SMALLEST))
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


def evaluate(sensor: Sensor, name: str, training: int, trials: int) -> tuple[Tuned, list[float]]:
    """Tune a method for a sensor and return its error for each of the sensor's disturbances."""
    method, setting = METHODS[name], sensor.setting()
    tuned = tune(method, setting, sensor.training(training), trials, seed=1)
    run = method.prepare(setting, tuned.values)
    return tuned, [
        mean(objective(r, run(r)[tuned.readout]) for r in sensor.held_out(disturbance))
        for disturbance in sensor.disturbances
    ]


def methods_for(sensor: Sensor) -> list[str]:
    """Return the methods that are compared for a sensor."""
    quiet = sensor.setting().noise == 0.0
    return [name for name, method in METHODS.items() if not (quiet and method.needs_noise)]
