# SPDX-License-Identifier: Apache-2.0
"""
The sliding mode observers, all of them by the core's own Observer, and ours as users get it.

Ours has the gains that `tune` finds, by its search, or is self-tuning; both run in the online
estimator, by the node's code. Levant's differentiator and its gains: A. Levant, International
Journal of Control 76(9-10), 2003, doi:10.1080/0020717031000099029.
"""

from collections.abc import Callable, Mapping
from contextlib import redirect_stderr
from functools import lru_cache, partial
from io import StringIO
from typing import Any

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.cli.command import shipped
from fhaosmo_ros.tools.tuning.objective import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.search import Dimension
from fhaosmo_ros.tools.tuning.tuner import DERIVATIVES, RATES, Tuner
import numpy as np
from studies import harness
from studies.comparison.methods.method import (
    Estimates,
    JUDGED_FROM,
    Method,
    OURS,
    PAPER,
    Run,
    Search,
    SELF_TUNING,
    Setting,
    SLIDING,
    untuned,
    Values,
)

RECURSIVE = (1.1, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Levant's lambda_0 .. lambda_5 of the recursive form, for a Lipschitz constant of 1."""
GRID = len(DERIVATIVES) * len(RATES)
"""Trials that `tune` uses before its search."""
Parameters = Callable[[Setting, Values], Mapping[str, Any]]


def model_of(setting: Setting) -> dict[str, Any]:
    """Return what the estimators are told, as parameters."""
    return {'order': setting.model.order, 'phi': list(setting.model.phi)}


def _sliding(parameters: Parameters, setting: Setting, values: Values) -> Run:
    """Return a run of the core's Observer with these parameters."""
    observer = Observer(model_of(setting) | dict(parameters(setting, values)))
    n = setting.model.order

    def estimate(r: Recording) -> dict[str, Estimates]:
        observer.reset()
        found = observer.run(r.t, r.y, r.u)
        internal = np.column_stack([found.z_hat[:, 0], found.z_tilde[:, : n - 1]])
        return {
            'filtered': Estimates(found.z_hat[:, :n], found.z_hat[:, n]),
            'internal': Estimates(internal, found.z_tilde[:, n - 1]),
        }

    return estimate


@lru_cache
def _paper() -> dict[str, Any]:
    """Return the paper's numbers that fit any plant: all but the model and the initial values."""
    values = load(shipped('config/paper.yaml'), 'estimator', OBSERVER_PARAMETERS)
    left_out = ('order', 'phi', 'variant', 'initial_estimate', 'initial_internal')
    kept = {k: v for k, v in values.items() if k not in left_out}
    return kept | {name: kept[name][:1] for name in ('lambda', 'alpha')}


def _papers(variant: str, *_: Any) -> Mapping[str, Any]:
    return _paper() | {'variant': variant, 'start_from_measurement': True}


def _levant(setting: Setting, values: Values) -> Mapping[str, Any]:
    """Non-recursive form: kappa_i = lambda_i kappa_{i+1}^(i / (i+1)) L^((N-i) / N)."""
    levels = setting.model.order + 1
    gains, kappa = [], 1.0
    for i in reversed(range(levels)):
        kappa = RECURSIVE[i] * kappa ** (i / (i + 1))
        gains.append(kappa * values['lipschitz'] ** ((levels - i) / levels))
    return {'structure': 'levant', 'variant': 'sign', 'scheme': 'implicit', 'lambda': gains}


def _levant_space(setting: Setting) -> tuple[Dimension, ...]:
    size = setting.size
    return (Dimension('lipschitz', 1e-4 * size, 1e8 * size, 10.0 * size),)


def _online(own: Values, setting: Setting, values: Values) -> Run:
    """Return a run of the online estimator with these parameters."""
    parameters = model_of(setting) | dict(values) | own
    known = setting.model.uses_input

    def estimate(r: Recording) -> dict[str, Estimates]:
        found = harness.observed(parameters, r.t, r.y, r.u if known else None)
        return {'filtered': Estimates(found.z, found.unknown_input)}

    return estimate


def _tune(search: Search) -> Values:
    """Return the parameters of the estimator that `tune` writes; its grid uses trials, too."""
    tuning = TUNE_PARAMETERS.complete(model_of(search.setting) | {'settled': JUDGED_FROM})
    recordings = list(search.recordings)
    with redirect_stderr(StringIO()):  # its progress bars
        tuner = Tuner(recordings, recordings[:1], {}, tuning, search.seed)
        return tuner.parameters(tuner.search(max(1, search.trials - GRID)).best)


PAPERS = {'sign': 'sign', 'fuzzy': 'fuzzy', 'adaptive': 'fuzzy_adaptive'}
OBSERVERS = (
    Method('Levant, implicit', SLIDING, _levant_space, partial(_sliding, _levant)),
    *(
        Method(f'paper: {name}', PAPER, untuned, partial(_sliding, partial(_papers, own)))
        for name, own in PAPERS.items()
    ),
    Method(OURS, OURS, untuned, partial(_online, {}), _tune),  # levant, fuzzy, predict_correct
    Method(SELF_TUNING, SELF_TUNING, untuned, partial(_online, harness.SELF_TUNING)),
)
