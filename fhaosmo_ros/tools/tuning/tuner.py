# SPDX-License-Identifier: Apache-2.0
"""One tuning: from recordings and parameters to the best gains, before anything is written."""

from collections.abc import Callable, Mapping
import hashlib
import json
import math
import time
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.cli.progress import progress
from fhaosmo_ros.tools.tuning.linear_gains import least_damping
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.search import minimise, Values
from fhaosmo_ros.tools.tuning.source import TuningData
from fhaosmo_ros.tools.tuning.space import changes, make_space
from fhaosmo_ros.tools.tuning.start import find_start, with_scheme
import numpy as np

DIGITS = 4
"""Of the gains that are written, unless rounding raises their objective by more than `LOSS`."""
LOSS = 5e-3
NEAR, FAR = 0.5, 3.0
"""`decades` around a start that a Kalman filter gave, and around any other one."""
LEAST_DAMPING, DAMPING_WEIGHT = 0.1, 10.0
"""Of the errors' dynamics: gains with less suit their recordings and fail on others."""
LOST_TIME, LOST_SAMPLES = 0.1, 20
"""
Seconds, and at least so many samples, for which the innovation exceeds the largest half-width
before the estimator restarts. With all levels saturated the chain of integrators may oscillate
without end.
"""


class TuningResult(NamedTuple):
    """The best values by dimension, rounded; trials of the study, and seconds of this run."""

    best: Values
    trials: int
    seconds: float


class Tuner:
    """
    Holds what a search needs.

    Parameters
    ----------
    data : TuningData
    estimator : mapping
        What the user set for the estimator.
    tuning : mapping
        Of `TUNE_PARAMETERS`, complete.
    seed : int
    jobs : int
        Threads that look for a start.
    stopped : callable
        Asked before each evaluation of the start; True ends it with the best so far.

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
        self,
        data: TuningData,
        estimator: Mapping[str, Any],
        tuning: Mapping[str, Any],
        seed: int,
        jobs: int = 1,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.data, self.tuning, self.seed = data, tuning, seed
        names = [rule.partition(' ')[0] for rule in tuning['search']]
        # The estimator may have a model of its own, other than the plant's.
        model = {name: tuning[name] for name in ('order', 'phi')}
        self.estimator = with_scheme(model | dict(estimator), data.training)
        self._choose = 'estimate_from' not in estimator
        gains, self.tried = find_start(
            data.training, self.estimator, names, self._objective, jobs, stopped
        )
        not_searched = {k: v for k, v in gains.items() if k not in names}
        self.estimator = not_searched | self.estimator
        self.training = self._objective(self.estimator)
        complete = ESTIMATOR_PARAMETERS.complete(self.estimator)
        self.held_out = Objective(
            data.held_out, complete, tuning, self._choose, self.training.scale
        )
        given = {name: value for name, value in estimator.items() if name in names}
        self.before_is_given = 'lambda' in given  # other parameters alone are no set of gains
        best = {k: v for k, v in gains.items() if k in names}
        # The user's own gains are a start, too: the tuned ones are never worse than they are.
        if self.before_is_given and self._evaluate(given) < self._evaluate(best):
            best = given
        observer = Observer(complete)
        self.space = make_space(
            tuning['search'],
            observer.parameters | best,
            observer.levels,
            tuning['decades'] or (NEAR if self.tried else FAR),
        )
        searched = changes({d.name: d.start for d in self.space})
        self.before = given if self.before_is_given else searched
        self.fixed = {k: v for k, v in self.estimator.items() if k not in searched}
        self._damping = min(LEAST_DAMPING, self._damped(searched))

    def _objective(self, estimator: Mapping[str, Any]) -> Objective:
        complete = ESTIMATOR_PARAMETERS.complete(estimator)
        return Objective(self.data.training, complete, self.tuning, self._choose)

    @property
    def study_name(self) -> str:
        """Name of the study: a digest of all that its trials depend on."""
        samples = [recording.y.tobytes() for recording in self.data.training]
        problem = json.dumps([dict(self.tuning), self.estimator, self.space], sort_keys=True)
        return f'tune-{hashlib.sha256(b"".join([problem.encode(), *samples])).hexdigest()[:16]}'

    def evaluate(self, values: Values) -> float:
        """Return the objective at a point of the space, larger where errors are badly damped."""
        gains = changes(values)
        objective = self._evaluate(gains)
        if math.isinf(objective):
            return objective
        missing = max(self._damping - self._damped(gains), 0.0)
        return objective * (1.0 + DAMPING_WEIGHT * missing)

    def _damped(self, gains: Mapping[str, Any]) -> float:
        return least_damping(Observer(ESTIMATOR_PARAMETERS.complete(self.estimator | dict(gains))))

    def _evaluate(self, gains: Mapping[str, Any]) -> float:
        try:
            return self.training(gains).objective
        except ConfigurationError:  # a value out of its bounds, or values that do not fit
            return math.inf

    def with_readout(self, gains: Mapping[str, Any]) -> dict[str, Any]:
        """Return gains with internal or filtered variables; held-out recordings do not decide."""
        return {'estimate_from': self.training(gains).estimate_from, **gains}

    def parameters(self, gains: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the estimator needs: what is fixed, and these gains."""
        values = self.fixed | self.with_readout(gains)
        shown = ESTIMATOR_PARAMETERS.complete(values)
        fuzzy = shown['structure'] == 'levant' and shown['variant'].startswith('fuzzy')
        if fuzzy and not shown['noise_size']:
            period = float(np.median(np.diff(self.data.training[0].t)))
            values = {
                'epsilon': max(shown['fuzzy_widths']),
                'divergence_time': float(f'{max(LOST_TIME, LOST_SAMPLES * period):.4g}'),
            } | values
        # The gains fit these only, so the file has them even where they are the defaults.
        for name in ('variant', 'scheme', 'unknown_input'):
            values[name] = shown[name]
        return ESTIMATOR_PARAMETERS.part_of(values)

    def search(
        self,
        trials: int,
        jobs: int = 1,
        storage: str | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> TuningResult | None:
        """
        Search until the study holds `trials`, or `stopped` returns True; None if it does at once.

        Parameters
        ----------
        trials, jobs : int
        storage : str, optional
            As for `minimise`; the study is named by what it searches.
        stopped : callable
            Asked before each trial.

        Raises
        ------
        ConfigurationError
            A storage that can't be used.

        """
        if stopped():
            return None
        begin = time.monotonic()
        with progress(total=trials, unit='trial', desc='tune', smoothing=0.05) as bar:
            found = minimise(
                self.evaluate, self.space, trials, self.seed, storage=storage,
                name=self.study_name, jobs=jobs, on_trial=bar.update, stopped=stopped,
            )  # fmt: skip
        best = {key: float(f'{v:.{DIGITS}g}') for key, v in found.best.items()}
        if self.evaluate(best) > (1.0 + LOSS) * self.evaluate(found.best):
            best = found.best
        return TuningResult(best, found.trials, time.monotonic() - begin)
