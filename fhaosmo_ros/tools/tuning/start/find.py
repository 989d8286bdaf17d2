# SPDX-License-Identifier: Apache-2.0
"""Where a search begins: with the best of the sets of gains that theory.py proposes."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import math
from typing import Any, NamedTuple, TypeVar

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import FIXED_GAMMA
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.cli.progress import progress
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.start.kalman import (
    around,
    GAMMA,
    grid,
    KalmanDesign,
    KalmanGains,
    ZOOMS,
)
from fhaosmo_ros.tools.tuning.start.theory import candidates, effective_noise
import numpy as np

SCHEME: Mapping[str, Any] = {
    'structure': 'levant',
    'scheme': 'predict_correct',
    'variant': 'fuzzy_adaptive',
    'gamma_rate': 0.0,
    'gamma_min': 1e-4,
    'fuzzy_growth': True,
}
"""What is tuned where the user sets no other structure or scheme."""
MEANT_FOR = ('lambda', 'alpha', 'epsilon', 'initial_internal')
"""A user who sets one of these has chosen structure and scheme: such values fit one of them."""
DERIVATIVES = (0, 1, 2, 3)
WORTH = 0.99
"""One more derivative of d must reduce the objective to this part of it."""
HOPELESS = 1.3
"""Numbers of derivatives that are this factor behind the best on the grid are given up."""
GAMMAS = (0.25, 0.5)
"""Powers gamma to start from with the other schemes, where gamma is searched."""

Candidate = TypeVar('Candidate')


class Start(NamedTuple):
    """
    Where a search begins.

    Attributes
    ----------
    gains : dict
        Parameters of the observer: those that are searched, and those that fit them.
    tried : dict
        Best objective by number of derivatives of d, where that number was open.

    """

    gains: dict[str, Any]
    tried: dict[int, float]


class StartProblem(NamedTuple):
    """
    What a start is searched for.

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
        Noise of y to assume where the recordings show less.

    """

    recordings: Sequence[Recording]
    estimator: Mapping[str, Any]
    names: Sequence[str]
    objective: Callable[[Mapping[str, Any]], Objective]
    least_noise: float = 0.0

    @property
    def observer(self) -> Observer:
        """An observer with what is set."""
        return Observer(ESTIMATOR_PARAMETERS.complete(self.estimator))

    @property
    def free_gamma(self) -> bool:
        """True if gamma_initial is searched and not set."""
        return 'gamma_initial' in self.names and 'gamma_initial' not in self.estimator


class CandidateEvaluator:
    """Evaluates candidates in several threads and shows a progress bar."""

    def __init__(self, jobs: int, stopped: Callable[[], bool]) -> None:
        self._pool, self._stopped = ThreadPoolExecutor(jobs), stopped
        self._bar = progress(unit='set', desc='start', leave=False)

    def __enter__(self) -> 'CandidateEvaluator':
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()
        self._bar.close()

    def best(
        self, objective: Callable[[Candidate], float], several: Sequence[Candidate]
    ) -> tuple[float, Candidate]:
        """Return the smallest objective and its candidate, the first of equals."""

        def evaluate(candidate: Candidate) -> float:
            try:
                return math.inf if self._stopped() else objective(candidate)
            except ConfigurationError:  # a value out of its bounds, or values that do not fit
                return math.inf
            finally:
                self._bar.update()

        self._bar.total = (self._bar.total or 0) + len(several)
        values = list(self._pool.map(evaluate, several))
        number = min(range(len(values)), key=values.__getitem__)
        return values[number], several[number]


def chosen_otherwise(estimator: Mapping[str, Any]) -> list[str]:
    """Return the parameters, as set by the user, that ask for something else than `SCHEME`."""
    found = [k for k in ('structure', 'scheme') if estimator.get(k, SCHEME[k]) != SCHEME[k]]
    if not estimator.get('unknown_input', True):
        found.append('unknown_input')
    return found + [k for k in MEANT_FOR if k in estimator]


def with_scheme(
    estimator: Mapping[str, Any], recordings: Sequence[Recording], least_noise: float = 0.0
) -> dict[str, Any]:
    """
    Return what the user set for the estimator, with `SCHEME` where that is open.

    The sizes of the noise, of the states and of d are those of the recordings. Without noise on y
    they are left out: nothing says how sure the observer is.
    """
    given = dict(estimator)
    if chosen_otherwise(given):
        return given
    period = float(f'{np.median(np.diff(recordings[0].t)):.4g}')
    noise = max(effective_noise(recordings), least_noise)
    sizes = np.sqrt(
        np.mean(np.concatenate([np.column_stack([r.z, r.d]) for r in recordings]) ** 2, axis=0)
    )
    known = {}
    if noise > 0.0 and (sizes > 0.0).all():
        z, d = [float(f'{x:.3g}') for x in sizes[:-1]], float(f'{sizes[-1]:.3g}')
        known = {'noise_size': float(f'{noise:.3g}'), 'state_sizes': z, 'unknown_input_size': d}
    return {**SCHEME, 'correction_period': period, **known, **given}


def find_start(problem: StartProblem, jobs: int, stopped: Callable[[], bool]) -> Start:
    """
    Evaluate the gains that theory proposes, and return the best of them.

    Parameters
    ----------
    problem : StartProblem
    jobs : int
        Threads.
    stopped : callable
        Asked before each evaluation; True ends the search with the best so far.

    """
    p = problem.observer.parameters
    with CandidateEvaluator(jobs, stopped) as evaluator:
        if p['scheme'] == 'predict_correct' and p['variant'].startswith('fuzzy'):
            found = _best_kalman_filter(problem, evaluator)
            if found is not None:
                return found
        return Start(_best_scaled_gains(problem, evaluator), {})


def _best_scaled_gains(problem: StartProblem, evaluator: CandidateEvaluator) -> dict[str, Any]:
    """Return the best of `theory.candidates`."""
    observer, recordings = problem.observer, problem.recordings
    p = observer.parameters
    gammas = [FIXED_GAMMA]
    if p['variant'].endswith('_adaptive'):
        gammas = [
            g for g in GAMMAS if problem.free_gamma and p['gamma_min'] <= g <= p['gamma_max']
        ]
        gammas = gammas or [p['gamma_initial']]
    objective = problem.objective(problem.estimator)
    several = candidates(
        recordings,
        observer.levels,
        max(effective_noise(recordings), problem.least_noise),
        p['structure'],
        gammas,
    )
    searched = [{k: v for k, v in gains.items() if k in problem.names} for gains in several]
    return evaluator.best(lambda gains: objective(gains).objective, searched)[1]


def _best_kalman_filter(problem: StartProblem, evaluator: CandidateEvaluator) -> Start | None:
    """Return the best Kalman filter with the best number of derivatives, or None without any."""
    estimator, p = problem.estimator, problem.observer.parameters
    gamma = p['gamma_initial']
    if not p['variant'].endswith('_adaptive'):
        gamma = FIXED_GAMMA
    elif problem.free_gamma:
        gamma = min(max(GAMMA, p['gamma_min']), p['gamma_max'])
    fixed = {k: v for k, v in estimator.items() if k not in problem.names}
    model = TriangularModel.of(p)
    open_ = not {'unknown_input_derivatives', 'lambda'} & estimator.keys()
    gains, objectives, found = {}, {}, {}
    for k in DERIVATIVES if open_ else [p['unknown_input_derivatives']]:
        make = KalmanGains(problem.recordings, fixed, model, k, gamma, problem.least_noise)
        judge = problem.objective({**estimator, 'unknown_input_derivatives': k})

        def objective(design: KalmanDesign, make: Any = make, judge: Any = judge) -> float:
            return float(judge(make(design)).objective)

        gains[k], objectives[k] = make, objective
        found[k] = evaluator.best(objective, grid())
    limit = HOPELESS * min(value for value, _ in found.values())
    for k, objective in objectives.items():
        if found[k][0] > limit:
            continue
        for zoom in ZOOMS:
            neighbours = list(around(found[k][1], zoom))
            found[k] = min(found[k], evaluator.best(objective, neighbours))
    tried = {k: value for k, (value, _) in found.items()}
    best = min(tried.values())
    if math.isinf(best):
        return None
    chosen = next(k for k, value in tried.items() if WORTH * value <= best)
    return Start(gains[chosen](found[chosen][1]), tried)
