# SPDX-License-Identifier: Apache-2.0
"""
Search for the parameters of any estimator that make an objective small, by Optuna.

The sampler is the evolution strategy with covariance matrix adaptation: N. Hansen and A.
Ostermeier, Evolutionary Computation 9(2), 2001, doi:10.1162/106365601750190398.
"""

from collections.abc import Callable, Sequence
import math
from typing import NamedTuple
import warnings

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import optuna
from optuna.study import MaxTrialsCallback
from optuna.trial import FrozenTrial, TrialState

Values = dict[str, float]

BAD = 1e9
"""Stands for an objective that is not finite: larger than any, and the sampler accepts it."""
SIGMA = 0.1
"""Standard deviation of the first proposals, as a share of each dimension's range."""
LONGEST = 200
"""Characters of another library's error that are shown."""


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
    The outcome of a search.

    Attributes
    ----------
    best : dict
        Values by name with the smallest objective.
    value : float
        The objective there.
    trials : int
        Finished trials of the study, also those of other processes.

    """

    best: Values
    value: float
    trials: int


def minimise(
    objective: Callable[[Values], float],
    space: Sequence[Dimension],
    trials: int,
    seed: int = 1,
    *,
    storage: str | None = None,
    name: str = 'study',
    jobs: int = 1,
    on_trial: Callable[[], object] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Result:
    """
    Minimise an objective.

    Parameters
    ----------
    objective : callable
        From values by name to a number; one that is not finite counts as `BAD`.
    space : sequence of Dimension
    trials : int
        Evaluations that the study shall hold at the end, with those that are in it already. The
        first one is at the start of each dimension.
    seed : int
        With one job and no storage, the result is a function of it.
    storage : str, optional
        As for `optuna.create_study`; in memory by default. All processes and machines that name
        the same storage and study search in one study.
    name : str
        Of the study in the storage.
    jobs : int
        Threads: an objective should spend its time in compiled code without the GIL.
    on_trial : callable
        Called after each trial of this process.
    stopped : callable
        Asked after each trial; True ends the search with the best trial so far.

    Raises
    ------
    ConfigurationError
        A storage that can't be used.

    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def evaluate(trial: optuna.Trial) -> float:
        values = {d.name: trial.suggest_float(d.name, d.low, d.high, log=d.log) for d in space}
        value = float(objective(values))
        return value if math.isfinite(value) else BAD

    def after(study: optuna.Study, trial: FrozenTrial) -> None:
        on_trial()
        if stopped():
            study.stop()

    def finished() -> int:
        return len(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))

    with warnings.catch_warnings():
        # Optuna 6, which setup.py excludes, removes x0 and sigma0.
        warnings.simplefilter('ignore', FutureWarning)
        start = {d.name: d.start for d in space}
        sampler = optuna.samplers.CmaEsSampler(
            x0=start, sigma0=SIGMA, seed=seed, warn_independent_sampling=False
        )
    try:
        study = optuna.create_study(
            storage=storage, sampler=sampler, study_name=name, load_if_exists=True
        )
    except Exception as error:  # SQLAlchemy and each driver have exceptions of their own
        raise ConfigurationError(
            f'storage {storage!r}: expected what Optuna takes, such as sqlite:///study.db or '
            f'postgresql+psycopg://user@host/name, got: {_one_line(error)}'
        ) from None
    try:
        done = finished()
        if not done:
            study.enqueue_trial(start, skip_if_exists=True)
        if done < trials:
            callbacks = [after, MaxTrialsCallback(trials, states=(TrialState.COMPLETE,))]
            study.optimize(evaluate, n_trials=trials - done, n_jobs=jobs, callbacks=callbacks)
        return Result(dict(study.best_params), study.best_value, finished())
    except (optuna.exceptions.StorageInternalError, UnboundLocalError) as error:
        if storage is None:  # else the second one: Optuna's loop raises it where a storage fails
            raise
        raise ConfigurationError(f'storage {storage!r}: {_one_line(error)}') from None


def _one_line(error: BaseException) -> str:
    """Return what a driver says, without the SQL statement and the advice that come with it."""
    while (before := error.__cause__ or error.__context__) is not None:
        error = before
    return ' '.join(str(error).split())[:LONGEST] or type(error).__name__
