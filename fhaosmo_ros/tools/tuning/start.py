# SPDX-License-Identifier: Apache-2.0
"""Where a search begins: the best of the sets of gains that theory names; see theory.py."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import math
from typing import Any, NamedTuple, TypeVar

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.family import Recording
from fhaosmo_ros.core.model import TriangularModel
from fhaosmo_ros.core.observer import FIXED_GAMMA, Observer
from fhaosmo_ros.core.parameters import OBSERVER_PARAMETERS
from fhaosmo_ros.tools.tuning.kalman_start import (
    around,
    GAMMA,
    grid,
    KalmanStart,
    NARROWER,
    Point,
    ZOOMS,
)
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.theory import candidates, effective_noise
import numpy as np
from tqdm import tqdm

SCHEME: Mapping[str, Any] = {
    'structure': 'levant', 'scheme': 'predict_correct', 'variant': 'fuzzy_adaptive',
    'gamma_rate': 0.0, 'gamma_min': 1e-4,
}  # fmt: skip
"""What is tuned where the user wants nothing else."""
MEANT_FOR = ('lambda', 'alpha', 'epsilon', 'initial_internal')
"""Who gives one of these has chosen: gains are for the structure and the scheme beside them."""
DERIVATIVES = (0, 1, 2, 3)
WORTH = 0.99
"""One derivative of d more, or narrower levels, have to bring at least this factor."""
HOPELESS = 1.3
"""What is this factor behind the best after the coarse grid is not looked at closer."""
GAMMAS = (0.25, 0.5)
"""Powers that the start of the other schemes may have, where they are searched."""

Asked = TypeVar('Asked')


class Start(NamedTuple):
    """
    Where a search begins.

    Attributes
    ----------
    gains : dict
        Parameters of the observer, those that are searched and those that go with them.
    tried : dict
        Best objective by number of derivatives of d, where that was open.

    """

    gains: dict[str, Any]
    tried: dict[int, float]


class Question(NamedTuple):
    """
    What a start is for.

    Attributes
    ----------
    recordings : sequence of Recording
    estimator : mapping
        What is set for the estimator, with the scheme; see `with_scheme`.
    names : sequence of str
        Parameters that are searched.
    objective : callable
        From what is set for the estimator to an Objective.
    least_noise : float
        Of y, where the recordings have less.

    """

    recordings: Sequence[Recording]
    estimator: Mapping[str, Any]
    names: Sequence[str]
    objective: Callable[[Mapping[str, Any]], Objective]
    least_noise: float = 0.0

    @property
    def observer(self) -> Observer:
        """An observer with what is set."""
        return Observer({k: v for k, v in self.estimator.items() if k in OBSERVER_PARAMETERS})

    @property
    def free_gamma(self) -> bool:
        """True if the search has its choice of the first gamma."""
        return 'gamma_initial' in self.names and 'gamma_initial' not in self.estimator


class Jury:
    """Judges several candidates at a time, with a progress bar."""

    def __init__(self, jobs: int, stopped: Callable[[], bool]) -> None:
        self._pool, self._stopped = ThreadPoolExecutor(jobs), stopped
        self._bar = tqdm(unit='set', desc='start', leave=False)

    def __enter__(self) -> 'Jury':
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()
        self._bar.close()

    def best(
        self, judge: Callable[[Asked], float], several: Sequence[Asked]
    ) -> tuple[float, Asked]:
        """Return the smallest value and what it is of, the first of equals."""

        def judged(one: Asked) -> float:
            try:
                return math.inf if self._stopped() else judge(one)
            except ConfigurationError:  # out of a parameter's bounds, or not good together
                return math.inf
            finally:
                self._bar.update()

        self._bar.total = (self._bar.total or 0) + len(several)
        values = list(self._pool.map(judged, several))
        number = min(range(len(values)), key=values.__getitem__)
        return values[number], several[number]


def with_scheme(estimator: Mapping[str, Any], recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return what the user set for the estimator, with the scheme to tune where that is open."""
    given = dict(estimator)
    others = any(given.get(k, SCHEME[k]) != SCHEME[k] for k in ('structure', 'scheme'))
    if others or not given.get('unknown_input', True) or any(k in given for k in MEANT_FOR):
        return given
    period = float(f'{np.median(np.diff(recordings[0].t)):.4g}')
    return {**SCHEME, 'correction_period': period, **given}


def begin(question: Question, jobs: int, stopped: Callable[[], bool]) -> Start:
    """
    Judge what theory proposes, and return the best of it.

    Parameters
    ----------
    question : Question
    jobs : int
        Threads.
    stopped : callable
        Asked before each evaluation; True ends it with what there is.

    """
    p = question.observer.parameters
    with Jury(jobs, stopped) as jury:
        if p['scheme'] == 'predict_correct' and p['variant'].startswith('fuzzy'):
            found = _of_kalman_filters(question, jury)
            if found is not None:
                return found
        return Start(_scaled(question, jury), {})


def _scaled(question: Question, jury: Jury) -> dict[str, Any]:
    """Return the best of `candidates`."""
    observer, recordings = question.observer, question.recordings
    p = observer.parameters
    gammas = [FIXED_GAMMA]
    if p['variant'].endswith('_adaptive'):
        gammas = [
            g for g in GAMMAS if question.free_gamma and p['gamma_min'] <= g <= p['gamma_max']
        ]
        gammas = gammas or [p['gamma_initial']]
    objective = question.objective(question.estimator)
    several = candidates(
        recordings,
        observer.levels,
        max(effective_noise(recordings), question.least_noise),
        p['structure'],
        gammas,
    )
    chosen = [{k: v for k, v in gains.items() if k in question.names} for gains in several]
    return jury.best(lambda gains: objective(gains).objective, chosen)[1]


def _of_kalman_filters(question: Question, jury: Jury) -> Start | None:
    """Return the best Kalman filter with the best number of derivatives; None if there is none."""
    estimator, p = question.estimator, question.observer.parameters
    gamma = p['gamma_initial']
    if not p['variant'].endswith('_adaptive'):
        gamma = FIXED_GAMMA
    elif question.free_gamma:
        gamma = min(max(GAMMA, p['gamma_min']), p['gamma_max'])
    fixed = {k: v for k, v in estimator.items() if k not in question.names}
    model = TriangularModel(p['phi'], p['order'])
    open_ = not {'unknown_input_derivatives', 'lambda'} & estimator.keys()
    starts, judges, found = {}, {}, {}
    for k in DERIVATIVES if open_ else [p['unknown_input_derivatives']]:
        start = KalmanStart(question.recordings, fixed, model, k, gamma, question.least_noise)
        objective = question.objective({**estimator, 'unknown_input_derivatives': k})

        def judge(point: Point, start: Any = start, objective: Any = objective) -> float:
            return float(objective(start(point)).objective)

        starts[k], judges[k] = start, judge
        found[k] = jury.best(judge, grid())
    limit = HOPELESS * min(value for value, _ in found.values())
    for k, judge in judges.items():
        if found[k][0] > limit:
            continue
        point = found[k][1]
        narrower = jury.best(judge, [point._replace(width=width) for width in NARROWER])
        if narrower[0] < WORTH * found[k][0]:
            found[k] = narrower
        for zoom in ZOOMS:
            found[k] = min(found[k], jury.best(judge, list(around(found[k][1], zoom))))
    tried = {k: value for k, (value, _) in found.items()}
    best = min(tried.values())
    if math.isinf(best):
        return None
    chosen = next(k for k, value in tried.items() if WORTH * value <= best)
    return Start(starts[chosen](found[chosen][1]), tried)
