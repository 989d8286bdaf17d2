# SPDX-License-Identifier: Apache-2.0
"""
Search for the parameters of any estimator that make an objective small, by Optuna.

The sampler is the evolution strategy with covariance matrix adaptation: N. Hansen and A.
Ostermeier, Evolutionary Computation 9(2), 2001, doi:10.1162/106365601750190398.
"""

from collections.abc import Callable, Sequence
import math
from typing import Any, NamedTuple
import warnings

from fhaosmo_ros.core.parameters.errors import ConfigurationError

Values = dict[str, float]

BAD = 1e9  # for an objective that is not finite: larger than any, and the sampler accepts it
SIGMA = 0.1  # standard deviation of the first proposals, as a share of each dimension's range


class Dimension(NamedTuple):
    """One parameter of a search."""

    name: str
    low: float
    high: float
    start: float  # where the search begins
    log: bool = True  # search in its logarithm


def minimise(
    objective: Callable[[Values], float],
    space: Sequence[Dimension],
    trials: int,
    seed: int = 1,
    *,
    storage: str | None = None,
    name: str | None = None,
    jobs: int = 1,
    on_trial: Callable[[], object] = lambda: None,
) -> Any:
    """
    Minimise an objective; return the study of Optuna, with `best_params` and `best_value`.

    The objective takes values by name; a result that is not finite counts as `BAD`. `trials` says
    how many evaluations the study shall hold at the end, with those that are in it already, also
    of other processes; the first one is at the start of each dimension. `storage` and `name` are
    as for `optuna.create_study`, in memory by default. With one job and no storage the result is a
    function of `seed`; more `jobs` are threads, so an objective should spend its time in compiled
    code without the GIL. `on_trial` is called after each trial of this process; True ends the
    search. Raises ConfigurationError if Optuna cannot use the storage, or is not installed.
    """
    try:  # here, as only this search needs them: a robot may lack them
        import cmaes  # noqa: F401 (Optuna imports it, later)
        import optuna
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f'{error.name} is not installed: make tune does it, or '
            "python3 -m pip install 'optuna>=4,<6' cmaes"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    start = {d.name: d.start for d in space}

    def evaluate(trial: Any) -> float:
        values = {d.name: trial.suggest_float(d.name, d.low, d.high, log=d.log) for d in space}
        value = float(objective(values))
        return value if math.isfinite(value) else BAD

    def after(study: Any, _: object) -> None:
        if on_trial() or finished(study) >= trials:
            study.stop()

    with warnings.catch_warnings():
        # Optuna 6, which setup.py excludes, removes x0 and sigma0.
        warnings.simplefilter('ignore', FutureWarning)
        sampler = optuna.samplers.CmaEsSampler(
            x0=start, sigma0=SIGMA, seed=seed, warn_independent_sampling=False
        )
    try:
        study = optuna.create_study(
            storage=storage, sampler=sampler, study_name=name, load_if_exists=True
        )
    except Exception as error:  # SQLAlchemy and each driver have exceptions of their own
        first = str(error).partition('\n')[0]
        raise ConfigurationError(f'storage {storage!r}: Optuna cannot use it: {first}') from None
    study.enqueue_trial(start, skip_if_exists=True)
    left = max(trials - finished(study), 0)
    study.optimize(evaluate, left, n_jobs=jobs, callbacks=[after])
    return study


def finished(study: Any) -> int:
    """Return the number of the finished trials of a study, also of those of other processes."""
    return sum(trial.state.name == 'COMPLETE' for trial in study.get_trials(deepcopy=False))
