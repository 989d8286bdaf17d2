# SPDX-License-Identifier: Apache-2.0
"""
Search for the parameters of any estimator that make an objective small.

::

    from fhaosmo_ros.core import Family
    from fhaosmo_ros.tools.tuning.search import Dimension, minimise

    training = Family({'noise_std': 1e-3, 'disturbances': ['steps']}).recordings(6)
    space = [Dimension('q', low=1e-6, high=1e6, start=1.0)]

    def objective(values):              # {'q': 0.7} -> a number; NaN and infinity count as bad
        return error_of_d(training, **values)

    result = minimise(objective, space, trials=2000)
    result.best, result.value           # {'q': ...} and the objective there

Several evaluations run at once in threads (`jobs`): an objective should spend its time in compiled
code that releases the GIL (``njit(nogil=True)``), and must not share scratch memory between calls.
With `storage` any number of processes and machines search in one study; see study.py.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
import math
import os
from typing import Any, NamedTuple
import warnings

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.tools.tuning.study import Desk, Point
import optuna
from optuna.distributions import FloatDistribution
from optuna.samplers import BaseSampler, CmaEsSampler, TPESampler

Values = dict[str, float]
Objective = Callable[[Values], float | Sequence[float]]

BAD = 1e9
"""Value of an objective that is not finite: worse than any, and still to be compared."""
SIGMA = 0.1
"""First standard deviation of a search, as a share of each dimension's range."""


class Dimension(NamedTuple):
    """
    One parameter of a search.

    Attributes
    ----------
    name : str
    low, high : float
        Bounds.
    start : float
        Where the search begins.
    log : bool
        Search in its logarithm.

    """

    name: str
    low: float
    high: float
    start: float
    log: bool = True


class Result(NamedTuple):
    """
    What a search has found.

    Attributes
    ----------
    best : dict
        Values by name with the smallest objective.
    value : float
    trials : list of Point
        All of the study, in the order in which they were finished; by all who shared it.

    """

    best: Values
    value: float
    trials: list[Point]


def minimise(
    objective: Objective,
    space: Sequence[Dimension],
    trials: int,
    *,
    seed: int = 1,
    jobs: int | None = None,
    storage: str | None = None,
    name: str = 'study',
    sampler: str = 'cmaes',
    population: int | None = None,
    on_trial: Callable[[int, float], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Result:
    """
    Minimise an objective.

    Parameters
    ----------
    objective : callable
        From values by name to a number, or to several: the first is minimised, the others are
        kept with the trial.
    space : sequence of Dimension
    trials : int
        Evaluations that the study shall hold at the end, with those that are in it already.
    seed : int
        With one job and a study of its own, the result is a function of it.
    jobs : int, optional
        Threads; one a core by default.
    storage : str, optional
        File of a journal, or URL of a data base, that keeps and shares the study called `name`.
        In memory by default.
    sampler : {'cmaes', 'tpe', 'random'}
    population : int, optional
        Of a generation of CMA-ES.
    on_trial : callable, optional
        Called with the number of finished trials and the best value, from any thread, one at a
        time.
    stopped : callable, optional
        Asked before each evaluation; True ends the search with what there is.

    Raises
    ------
    ConfigurationError
        A space or storage that can't be used.

    """
    check_space(space)
    jobs = jobs or os.cpu_count() or 1
    desk = Desk(
        lambda worker: make_sampler(sampler, space, seed + worker, population),
        {d.name: FloatDistribution(d.low, d.high, log=d.log) for d in space},
        storage, name,
    )  # fmt: skip

    def evaluate(fixed: Values | None = None) -> None:
        trial = desk.ask(fixed)
        values = objective(dict(trial.params))
        several = list(values) if isinstance(values, Sequence) else [values]
        first, *notes = (float(v) if math.isfinite(v) else BAD for v in several)
        desk.tell(trial, first, notes)
        if on_trial is not None:
            desk.report(on_trial)

    def work() -> None:
        while desk.begun < trials and not stopped():
            evaluate()

    if not desk.count:  # whatever comes, there is a result
        evaluate({d.name: d.start for d in space})
    with ThreadPoolExecutor(jobs) as pool:
        running = [pool.submit(work) for _ in range(jobs)]
        done, _ = wait(running, return_when=FIRST_EXCEPTION)
        trials = 0  # an error in one thread ends the others
        for future in done:
            future.result()
    points = desk.points()
    best = min(points, key=lambda point: point.values[0])
    return Result(best.parameters, best.values[0], points)


def make_sampler(
    kind: str, space: Sequence[Dimension], seed: int, population: int | None
) -> BaseSampler:
    """Return an Optuna sampler."""
    if kind == 'cmaes':
        with warnings.catch_warnings():
            # x0 and sigma0 go with Optuna 6, which setup.py excludes.
            warnings.simplefilter('ignore', FutureWarning)
            return CmaEsSampler(
                x0={d.name: d.start for d in space}, sigma0=SIGMA, seed=seed, popsize=population,
                warn_independent_sampling=False,
            )  # fmt: skip
    if kind == 'tpe':
        return TPESampler(seed=seed, multivariate=True)
    if kind == 'random':
        return optuna.samplers.RandomSampler(seed=seed)
    raise ConfigurationError(f'sampler: expected one of cmaes, tpe, random, got {kind!r}')


def check_space(space: Sequence[Dimension]) -> None:
    """Raise ConfigurationError unless there is something to search in, with sense in it."""
    if not space:
        raise ConfigurationError('search: expected at least one dimension, got none')
    for d in space:
        if not (math.isfinite(d.low) and math.isfinite(d.high) and d.low < d.high):
            raise ConfigurationError(
                f"dimension '{d.name}': expected finite bounds, the lower one first, "
                f'got {d.low} and {d.high}'
            )
        if not d.low <= d.start <= d.high:
            raise ConfigurationError(
                f"dimension '{d.name}': expected a start from {d.low} to {d.high}, got {d.start}"
            )
        if d.log and d.low <= 0.0:
            raise ConfigurationError(
                f"dimension '{d.name}': expected bounds > 0 for a logarithm, got {d.low}"
            )


def log_dimensions(starts: Mapping[str, Any], decades: float = 3.0) -> list[Dimension]:
    """Return a log-scaled dimension for each start, `decades` to both sides."""
    factor = 10.0**decades
    return [Dimension(name, s / factor, s * factor, s) for name, s in starts.items()]
