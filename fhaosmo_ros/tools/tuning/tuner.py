# SPDX-License-Identifier: Apache-2.0
"""One tuning: from data and parameters to the best gains, before anything is written."""

from collections.abc import Callable, Mapping
import hashlib
import json
import math
import time
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.observer import Observer
from fhaosmo_ros.core.parameters import OBSERVER_PARAMETERS, ONLINE_PARAMETERS
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.search import minimise, Result, Values
from fhaosmo_ros.tools.tuning.source import Data
from fhaosmo_ros.tools.tuning.space import changes, make_space
from fhaosmo_ros.tools.tuning.theory import candidates, effective_noise
from tqdm import tqdm

DIGITS = 4
"""Of the gains that are written; what is judged is what is written."""


class Found(NamedTuple):
    """
    The outcome of a search.

    Attributes
    ----------
    best : dict
        Values by dimension, rounded.
    result : Result
    seconds : float
    pareto : str or None
        Second objective.

    """

    best: Values
    result: Result
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

    Attributes
    ----------
    before : dict
        Gains to compare with: the user's, or where the search begins.
    fixed : dict
        Parameters of the estimator that are not searched.
    training, held_out : Objective
    space : list of Dimension

    Raises
    ------
    ConfigurationError
        Parameters that do not fit together, or recordings that do not fit them.

    """

    def __init__(
        self, data: Data, estimator: Mapping[str, Any], tuning: Mapping[str, Any], seed: int
    ) -> None:
        self.data, self.tuning, self.seed = data, tuning, seed
        model = {name: tuning[name] for name in ('order', 'phi')}
        self.estimator = dict(estimator) | model
        online = {k: v for k, v in self.estimator.items() if k in ONLINE_PARAMETERS}
        complete = Observer({k: v for k, v in online.items() if k in OBSERVER_PARAMETERS})
        choose = 'estimate_from' not in estimator
        self.training = Objective(data.training, online, tuning, choose)
        self.held_out = Objective(data.held_out, online, tuning, choose, self.training.scale)
        names = [rule.split()[0] for rule in tuning['search'] if rule.split()]
        given = {name: value for name, value in estimator.items() if name in names}
        by_theory = self._by_theory(complete.levels, names)
        # The user's own gains count, too: a tuning never ends worse than they are.
        start = min(
            [by_theory, given] if given else [by_theory],
            key=lambda gains: self.training(gains).objective,
        )
        self.before_is_given = bool(given)
        parameters = complete.parameters
        self.space = make_space(
            tuning['search'], parameters | start, complete.levels, tuning['decades']
        )
        searched = changes({d.name: d.start for d in self.space})
        self.before = given or searched
        self.fixed = {k: v for k, v in self.estimator.items() if k not in searched}

    def _by_theory(self, levels: int, names: list[str]) -> dict[str, Any]:
        recordings = self.data.training
        several = candidates(recordings, levels, effective_noise(recordings))
        chosen = ({k: v for k, v in gains.items() if k in names} for gains in several)
        return min(chosen, key=lambda gains: self._judge(gains)[0])

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

    def judge(self, values: Values, pareto: str | None = None) -> tuple[float, ...]:
        """Return the objective, or the two, of the training at a point of the space."""
        return self._judge(changes(values), pareto)

    def _judge(self, gains: Mapping[str, Any], pareto: str | None = None) -> tuple[float, ...]:
        try:
            verdict = self.training(gains)
        except ConfigurationError:  # out of a parameter's bounds, or not good together
            return (math.inf,) if pareto is None else (math.inf, math.inf)
        if pareto is None:
            return (verdict.objective,)
        return verdict.error, getattr(verdict, pareto)

    def search(
        self, trials: int, jobs: int, storage: str, sampler: str, pareto: str | None,
        stopped: Callable[[], bool],
    ) -> Found | None:  # fmt: skip
        """
        Search until the study holds `trials`, or `stopped` says so; None if it says so at once.

        Raises
        ------
        ConfigurationError
            A storage that can't be used.

        """
        if stopped():
            return None
        begin = time.monotonic()

        name = self.study_name + (f'-{pareto}' if pareto else '')
        with tqdm(total=trials, unit='trial', desc='tune', smoothing=0.05) as bar:

            def show(count: int, best: float) -> None:
                if not bar.n:
                    bar.initial = count - 1
                bar.set_postfix_str(f'best {best:.4f}', refresh=False)
                bar.update(count - bar.n)

            result = minimise(
                lambda values: self.judge(values, pareto), self.space, trials, seed=self.seed,
                jobs=jobs, storage=storage, name=name, sampler=sampler,
                objectives=2 if pareto else 1, on_trial=show, stopped=stopped,
            )  # fmt: skip
        best = result.best
        if pareto is not None:
            # Of the front, the one that the weights prefer.
            weight = self.tuning[f'{pareto}_weight']
            best = min(
                result.front, key=lambda point: point.values[0] + weight * point.values[1]
            ).parameters
        rounded = {key: float(f'{value:.{DIGITS}g}') for key, value in best.items()}
        return Found(rounded, result, time.monotonic() - begin, pareto)
