# SPDX-License-Identifier: Apache-2.0
"""The sliding mode observers, all of them by the core's own Observer."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

from fhaosmo_ros.core.family import Recording
from fhaosmo_ros.core.observer import Observer
from fhaosmo_ros.core.parameter_file import load
from fhaosmo_ros.core.parameters import OBSERVER_PARAMETERS
from fhaosmo_ros.tools.comparison.methods import Method, Run, Setting, Values
from fhaosmo_ros.tools.comparison.scores import Estimates
from fhaosmo_ros.tools.share import shipped
from fhaosmo_ros.tools.tuning.search import Dimension
import numpy as np

Parameters = Callable[[Setting, Values], Mapping[str, Any]]

LEVANT = {2: (1.5, 1.1), 3: (2.0, 2.12, 1.1), 4: (3.0, 4.16, 3.06, 1.1), 5: (5.0, 9.3, 10.03, 6.75, 1.1)}
"""Levant's gains of the non-recursive differentiator for a Lipschitz constant of 1, by levels."""


def _prepare(parameters: Parameters) -> Callable[[Setting, Values], Run]:
    def prepare(setting: Setting, values: Values) -> Run:
        model = setting.model
        observer = Observer(
            {'order': model.order, 'phi': list(model.phi)} | dict(parameters(setting, values))
        )
        n = model.order

        def estimate(r: Recording) -> dict[str, Estimates]:
            observer.reset()
            found = observer.run(r.t, r.y, r.u)
            internal = np.column_stack([found.z_hat[:, 0], found.z_tilde[:, : n - 1]])
            return {
                'filtered': Estimates(found.z_hat[:, :n], found.z_hat[:, n]),
                'internal': Estimates(internal, found.z_tilde[:, n - 1]),
            }

        return estimate

    return prepare


@lru_cache
def _paper() -> dict[str, Any]:
    values = load(shipped('config/paper.yaml'), 'estimator')
    names = ('epsilon', 'fuzzy_widths', 'fuzzy_shape', 'gamma_rate', 'gamma_initial', 'gamma_min')
    return {name: values[name] for name in (*names, 'gamma_max')}


def _papers_gains(variant: str) -> Parameters:
    def parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
        gains = {name: values for name, values in (('lambda', [15.0]), ('alpha', [30.0]))}
        return _paper() | gains | {'variant': variant, 'scheme': 'explicit'}

    return parameters


def _levant(scheme: str) -> Parameters:
    def parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
        levels = setting.model.order + 1
        gains = [
            k * values['lipschitz'] ** ((i + 1) / levels) for i, k in enumerate(LEVANT[levels])
        ]
        return {'structure': 'levant', 'variant': 'sign', 'scheme': scheme, 'lambda': gains}

    return parameters


def _levant_space(setting: Setting) -> tuple[Dimension, ...]:
    return (Dimension('lipschitz', 1e-3 * setting.size, 1e6 * setting.size, setting.size),)
