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
        A space or storage that can't be used.

    """
    check_space(space)
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def evaluate(trial: optuna.Trial) -> float:
        values = {d.name: trial.suggest_float(d.name, d.low, d.high, log=d.log) for d in space}
        value = float(objective(values))
        return value if math.isfinite(value) else BAD

    def after(study: optuna.Study, trial: FrozenTrial) -> None:
        on_trial()
        if stopped():
            study.stop()

    study = _open_study(storage, name, _sampler(space, seed))
    try:
        done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        if not done:
            study.enqueue_trial({d.name: d.start for d in space}, skip_if_exists=True)
        left = trials - len(done)
        if left > 0:
            callbacks = [after, MaxTrialsCallback(trials, states=(TrialState.COMPLETE,))]
            study.optimize(evaluate, n_trials=left, n_jobs=jobs, callbacks=callbacks)
        count = len(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
        return Result(dict(study.best_params), study.best_value, count)
    except Exception as error:
        # Where a storage fails, Optuna's loop may fail in turn: its own error is further down.
        if any(isinstance(e, optuna.exceptions.StorageInternalError) for e in _chain(error)):
            raise ConfigurationError(f'storage {storage!r}: {_one_line(error)}') from None
        raise


def _open_study(
    storage: str | None, name: str, sampler: optuna.samplers.BaseSampler
) -> optuna.Study:
    try:
        return optuna.create_study(
            storage=storage, sampler=sampler, study_name=name, load_if_exists=True
        )
    except Exception as error:  # SQLAlchemy and each driver have exceptions of their own
        raise ConfigurationError(
            f'storage {storage!r}: expected what Optuna takes, such as sqlite:///study.db or '
            f'postgresql+psycopg://user@host/name, got: {_one_line(error)}'
        ) from None


def _one_line(error: BaseException) -> str:
    """Return what went wrong, without the SQL statement and the advice that come with it."""
    first = _chain(error)[-1]  # the driver's error says more than those that follow from it
    return ' '.join(str(first).split())[:LONGEST] or type(first).__name__


def _chain(error: BaseException) -> list[BaseException]:
    """Return an error and those that it came from, the first one last."""
    chain = [error]
    while (before := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(before)
    return chain


def _sampler(space: Sequence[Dimension], seed: int) -> optuna.samplers.BaseSampler:
    with warnings.catch_warnings():
        # Optuna 6, which setup.py excludes, removes x0 and sigma0.
        warnings.simplefilter('ignore', FutureWarning)
        return optuna.samplers.CmaEsSampler(
            x0={d.name: d.start for d in space},
            sigma0=SIGMA,
            seed=seed,
            warn_independent_sampling=False,
        )


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
