# SPDX-License-Identifier: Apache-2.0
"""
Search for the parameters of any estimator that make an objective small.

::

    from fhaosmo_ros.core import Family
    from fhaosmo_ros.tools.tuning.search.minimise import Dimension, minimise

    training = Family({'noise_std': 1e-3, 'disturbances': ['steps']}).recordings(6)
    space = [Dimension('q', low=1e-6, high=1e6, start=1.0)]

    def objective(values):              # {'q': 0.7} -> a number; NaN and infinity count as bad
        return error_of_d(training, **values)

    result = minimise(objective, space, 2000)
    result.best, result.value           # {'q': ...} and the objective there

Several evaluations run at once in threads (`jobs`): an objective should spend its time in compiled
code that releases the GIL (``njit(nogil=True)``), and must not share scratch memory between calls.
With a `storage` any number of processes and machines search in one study; see study.py.

The sampler `cmaes` is the evolution strategy with covariance matrix adaptation: N. Hansen and A.
Ostermeier, Evolutionary Computation 9(2), 2001, doi:10.1162/106365601750190398. `tpe` is the tree
of Parzen estimators: J. Bergstra et al., NeurIPS 24, 2011.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
import math
import os
from typing import Any, NamedTuple
import warnings

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.tuning.search.study import FinishedTrial, SharedStudy
import optuna
from optuna.distributions import FloatDistribution
from optuna.samplers import BaseSampler, CmaEsSampler, TPESampler

Values = dict[str, float]
Objective = Callable[[Values], float | Sequence[float]]

BAD = 1e9
"""Stands for an objective that is not finite: larger than any, and samplers accept it."""
SIGMA = 0.1
"""Standard deviation of the first proposals, as a share of each dimension's range."""


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


class StudyOptions(NamedTuple):
    """
    Which sampler proposes the trials, and where they are kept.

    Attributes
    ----------
    seed : int
        With one job and no storage, the result is a function of the seed.
    sampler : {'cmaes', 'tpe', 'random'}
    storage : str or None
        File of a journal, or URL of a data base, that keeps and shares the study; None for memory.
    name : str
        Of the study in the storage.

    """

    seed: int = 1
    sampler: str = 'cmaes'
    storage: str | None = None
    name: str = 'study'


IN_MEMORY = StudyOptions()


class Result(NamedTuple):
    """
    The outcome of a search.

    Attributes
    ----------
    best : dict
        Values by name with the smallest objective.
    value : float
        The objective there.
    trials : list of FinishedTrial
        All trials of the study, also those of other processes, in the order in which this
        process learnt of them.
    failure : str or None
        Why the storage failed in the middle, which ended the search; the trials are those that
        this process knows.

    """

    best: Values
    value: float
    trials: list[FinishedTrial]
    failure: str | None


def minimise(
    objective: Objective,
    space: Sequence[Dimension],
    trials: int,
    options: StudyOptions = IN_MEMORY,
    *,
    jobs: int | None = None,
    on_trial: Callable[[int, float], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Result:
    """
    Minimise an objective.

    Parameters
    ----------
    objective : callable
        From values by name to a number, or to several: the first is minimised, the others are
        stored with the trial.
    space : sequence of Dimension
    trials : int
        Evaluations that the study shall hold at the end, with those that are in it already.
    options : StudyOptions
    jobs : int, optional
        Threads; one a core by default.
    on_trial : callable, optional
        Called with the number of finished trials and the best value, from any thread, one at a
        time.
    stopped : callable, optional
        Asked before each evaluation; True ends the search with the best trial so far.

    Raises
    ------
    ConfigurationError
        A space or storage that can't be used. (See `Result` for one that fails later.)

    """
    check_space(space)
    jobs = jobs or os.cpu_count() or 1
    study = SharedStudy(
        lambda worker: make_sampler(options.sampler, space, options.seed + worker),
        {d.name: FloatDistribution(d.low, d.high, log=d.log) for d in space},
        options.storage,
        options.name,
    )

    def evaluate(fixed: Values | None = None) -> None:
        trial = study.ask(fixed)
        values = objective(dict(trial.params))
        several = list(values) if isinstance(values, Sequence) else [values]
        first, *notes = (float(v) if math.isfinite(v) else BAD for v in several)
        study.tell(trial, first, notes)
        if on_trial is not None:
            study.report(on_trial)

    def work() -> None:
        while study.started < trials and not (stopped() or study.failure):
            evaluate()

    if not study.count:  # even a search that is stopped at once has a result
        evaluate({d.name: d.start for d in space})
    with ThreadPoolExecutor(jobs) as pool:
        running = [pool.submit(work) for _ in range(jobs)]
        done, _ = wait(running, return_when=FIRST_EXCEPTION)
        trials = 0  # an error in one thread ends the others
        for future in done:
            future.result()
    finished = study.finished()
    best = min(finished, key=lambda trial: trial.values[0])
    return Result(best.parameters, best.values[0], finished, study.failure)


def make_sampler(kind: str, space: Sequence[Dimension], seed: int) -> BaseSampler:
    """Return an Optuna sampler."""
    if kind == 'cmaes':
        with warnings.catch_warnings():
            # Optuna 6, which setup.py excludes, removes x0 and sigma0.
            warnings.simplefilter('ignore', FutureWarning)
            return CmaEsSampler(
                x0={d.name: d.start for d in space},
                sigma0=SIGMA,
                seed=seed,
                warn_independent_sampling=False,
            )
    if kind == 'tpe':
        return TPESampler(seed=seed, multivariate=True)
    if kind == 'random':
        return optuna.samplers.RandomSampler(seed=seed)
    raise ConfigurationError(f'sampler: expected one of cmaes, tpe, random, got {kind!r}')


def check_space(space: Sequence[Dimension]) -> None:
    """Raise ConfigurationError for a space without dimensions, or with impossible bounds."""
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
