# SPDX-License-Identifier: Apache-2.0
"""One tuning: from data and parameters to the best gains, before anything is written."""

from collections.abc import Callable, Mapping, Sequence
import hashlib
import json
import math
import time
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.observer import Observer
from fhaosmo_ros.core.parameters import OBSERVER_PARAMETERS, ONLINE_PARAMETERS
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.search import minimise, Values
from fhaosmo_ros.tools.tuning.source import Data
from fhaosmo_ros.tools.tuning.space import changes, make_space
from fhaosmo_ros.tools.tuning.start import begin, Question, with_scheme
from fhaosmo_ros.tools.tuning.study import Point
from tqdm import tqdm

DIGITS = 4
"""Of the gains that are written, unless rounding makes them worse by more than `LOSS`."""
LOSS = 5e-3
NEAR, FAR = 0.5, 3.0
"""`decades` around a start that a Kalman filter gave, and around any other one."""
PARETO_WEIGHTS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Of the second objective, a search each."""


class Marks(NamedTuple):
    """What is kept of a trial; see `Verdict`."""

    objective: float
    error: float
    chatter: float
    settling: float


class Found(NamedTuple):
    """
    The outcome of a search.

    Attributes
    ----------
    best : dict
        Values by dimension, rounded.
    trials : list of Point
    seconds : float
    pareto : str or None
        Second objective.

    """

    best: Values
    trials: list[Point]
    seconds: float
    pareto: str | None


class Tuner:
    """
    Holds what a search needs.

    Parameters
    ----------
    data : Data
    estimator : mapping
        What the user set for the estimator.
    tuning : mapping
        Of `TUNE_PARAMETERS`, complete.
    seed : int
    jobs : int
        Threads that look for a start.
    stopped : callable
        Asked now and then; True ends that with what there is.

    Attributes
    ----------
    before : dict
        Gains to compare with: the user's, or where the search begins.
    fixed : dict
        Parameters of the estimator that are not searched.
    training, held_out : Objective
    space : list of Dimension
    tried : dict
        Objective of the best Kalman filter by number of derivatives of d; see start.py.

    Raises
    ------
    ConfigurationError
        Parameters that do not fit together, or recordings that do not fit them.

    """

    def __init__(
        self, data: Data, estimator: Mapping[str, Any], tuning: Mapping[str, Any], seed: int,
        jobs: int = 1, stopped: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        self.data, self.tuning, self.seed = data, tuning, seed
        names = [rule.split()[0] for rule in tuning['search'] if rule.split()]
        # The estimator may have a model of its own, other than the plant's.
        model = {name: tuning[name] for name in ('order', 'phi')}
        self.estimator = with_scheme(model | dict(estimator), data.training)
        self._choose = 'estimate_from' not in estimator
        begun = begin(
            Question(data.training, self.estimator, names, self._objective, data.least_noise),
            jobs, stopped,
        )  # fmt: skip
        self.tried = begun.tried
        beside = {k: v for k, v in begun.gains.items() if k not in names}
        self.estimator = beside | self.estimator
        self.training = self._objective(self.estimator)
        self.held_out = Objective(
            data.held_out, _online(self.estimator), tuning, self._choose, self.training.scale
        )
        given = {name: value for name, value in estimator.items() if name in names}
        given = given if 'lambda' in given else {}  # one number more or less is no set of gains
        by_theory = {k: v for k, v in begun.gains.items() if k in names}
        # The user's own gains count, too: a tuning never ends worse than they are.
        start = min(
            [by_theory, given] if given else [by_theory],
            key=lambda gains: self._judge(gains).objective,
        )
        self.before_is_given = bool(given)
        complete = Observer({k: v for k, v in self.estimator.items() if k in OBSERVER_PARAMETERS})
        self.space = make_space(
            tuning['search'], complete.parameters | start, complete.levels,
            tuning['decades'] or (NEAR if self.tried else FAR),
        )  # fmt: skip
        searched = changes({d.name: d.start for d in self.space})
        self.before = given or searched
        self.fixed = {k: v for k, v in self.estimator.items() if k not in searched}

    def _objective(self, estimator: Mapping[str, Any]) -> Objective:
        return Objective(self.data.training, _online(estimator), self.tuning, self._choose)

    @property
    def study_name(self) -> str:
        """Say what the study is about: another question must not go on with its trials."""
        question = json.dumps(
            [self.tuning, self.data.parameters, self.estimator, self.space], sort_keys=True
        )
        digest = hashlib.sha256(question.encode())
        for recording in self.data.training:
            digest.update(recording.y.tobytes())
        return f'tune-{digest.hexdigest()[:16]}'

    def judge(self, values: Values) -> Marks:
        """Return the marks of the training at a point."""
        return self._judge(changes(values))

    def _judge(self, gains: Mapping[str, Any]) -> Marks:
        try:
            verdict = self.training(gains)
        except ConfigurationError:  # out of a parameter's bounds, or not good together
            return Marks(*(math.inf,) * 4)
        return Marks(*verdict[:4])

    def search(
        self, trials: int, jobs: int, storage: str, sampler: str, pareto: str | None,
        stopped: Callable[[], bool],
    ) -> Found | None:  # fmt: skip
        """
        Search until the study holds `trials`, or `stopped` says so; None if it says so at once.

        For a front, one search after the other minimises error + weight * `pareto`, each from the
        best that the ones before it have seen.

        Raises
        ------
        ConfigurationError
            A storage that can't be used.

        """
        if stopped():
            return None
        begin = time.monotonic()
        weights = PARETO_WEIGHTS if pareto else (0.0,)
        each = -(-trials // len(weights))
        points: list[Point] = []
        with tqdm(total=each * len(weights), unit='trial', desc='tune', smoothing=0.05) as bar:
            for weight in weights:
                name, value = self.study_name, _value(pareto, weight)
                space = list(self.space)
                if pareto:
                    name += f'-{pareto}-{weight:g}'
                if points:
                    start = min(points, key=lambda p: value(marks(p))).parameters
                    space = [d._replace(start=start[d.name]) for d in space]

                def objective(values: Values, value: Any = value) -> tuple[float, ...]:
                    judged = self.judge(values)
                    return (value(judged), *judged)

                def show(count: int, best: float, done: int = len(points)) -> None:
                    if not bar.n:
                        bar.initial = count - 1
                    bar.set_postfix_str(f'best {best:.4f}', refresh=False)
                    bar.update(done + count - bar.n)

                points += minimise(
                    objective, space, each, seed=self.seed, jobs=jobs, storage=storage, name=name,
                    sampler=sampler, on_trial=show, stopped=stopped,
                ).trials  # fmt: skip
                if stopped():
                    break
        best = min(points, key=lambda point: marks(point).objective).parameters
        rounded = {key: float(f'{v:.{DIGITS}g}') for key, v in best.items()}
        if self.judge(rounded).objective <= (1.0 + LOSS) * self.judge(best).objective:
            best = rounded
        return Found(best, points, time.monotonic() - begin, pareto)


def _online(estimator: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in estimator.items() if k in ONLINE_PARAMETERS}


def marks(point: Point) -> Marks:
    """Return what was noted with a trial."""
    return Marks(*point.values[1:])


def front(points: Sequence[Point], second: str) -> list[Marks]:
    """Return the marks that no other ones beat in error and in `second`, by error."""
    found: list[Marks] = []
    best = math.inf
    for mark in sorted(map(marks, points), key=lambda m: (m.error, getattr(m, second))):
        if getattr(mark, second) < best:
            best = getattr(mark, second)
            found.append(mark)
    return found


def _value(pareto: str | None, weight: float) -> Callable[[Marks], float]:
    if pareto is None:
        return lambda mark: mark.objective
    return lambda mark: mark.error + weight * float(getattr(mark, pareto))
