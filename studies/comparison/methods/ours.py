# SPDX-License-Identifier: Apache-2.0
"""
Our observer as users get it: with the gains that `tune` finds, and self-tuning.

Both run in the online estimator, by the node's code. The search is that of `tune`.
"""

from collections.abc import Callable
from contextlib import redirect_stderr
from io import StringIO
from typing import Any

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.objective import FIRST_STAMP
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.tuner import DERIVATIVES, RATES, Tuner
import numpy as np
from studies import harness
from studies.comparison.methods.method import (
    Estimates,
    JUDGED_FROM,
    Method,
    OURS,
    Run,
    Search,
    SELF_TUNING,
    Setting,
    untuned,
    Values,
)

GOAL = {'settled': JUDGED_FROM}
GRID = len(DERIVATIVES) * len(RATES)


def model_of(setting: Setting) -> dict[str, Any]:
    """Return what the estimators are told, as parameters."""
    return {'order': setting.model.order, 'phi': list(setting.model.phi)}


def _prepared(own: Values) -> Callable[[Setting, Values], Run]:
    def prepare(setting: Setting, values: Values) -> Run:
        estimator = OnlineEstimator(model_of(setting) | dict(values) | own)
        u = estimator.observer.uses_input

        def estimate(r: Recording) -> dict[str, Estimates]:
            estimator.reset()
            stamps = FIRST_STAMP + np.round(r.t * 1e9).astype(np.int64)
            found = estimator.run(stamps, r.y, r.u if u else None)
            return {'filtered': Estimates(found.z, found.unknown_input)}

        return estimate

    return prepare


def _tune(search: Search) -> Values:
    """Return the parameters of the estimator that `tune` writes; its grid uses trials, too."""
    tuning = TUNE_PARAMETERS.complete(model_of(search.setting) | GOAL)
    recordings = list(search.recordings)
    with redirect_stderr(StringIO()):  # its progress bars
        tuner = Tuner(recordings, recordings[:1], {}, tuning, search.seed)
        return tuner.parameters(tuner.search(max(1, search.trials - GRID)).best)


OUR_METHODS = (
    Method(OURS, OURS, untuned, _prepared({}), _tune),  # levant, fuzzy, predict_correct
    Method(SELF_TUNING, SELF_TUNING, untuned, _prepared(harness.SELF_TUNING)),
)
