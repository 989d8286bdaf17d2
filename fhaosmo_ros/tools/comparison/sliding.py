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

OURS = 'ours'
RECURSIVE = (1.1, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Levant's lambda_0 .. lambda_5 of the recursive form, for a Lipschitz constant of 1."""


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
    """Return the paper's numbers that fit any plant: all but the model and the initial values."""
    values = load(shipped('config/paper.yaml'), 'estimator')
    left_out = ('order', 'phi', 'variant', 'initial_estimate', 'initial_internal')
    kept = {k: v for k, v in values.items() if k in OBSERVER_PARAMETERS and k not in left_out}
    return kept | {name: kept[name][:1] for name in ('lambda', 'alpha')}


def _papers_gains(variant: str) -> Parameters:
    def parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
        del setting, values
        return _paper() | {'variant': variant, 'start_from_measurement': True}

    return parameters


def _levant(scheme: str) -> Parameters:
    def parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
        """Non-recursive form: kappa_i = lambda_i kappa_{i+1}^(i / (i+1)) L^((N-i) / N)."""
        levels = setting.model.order + 1
        gains, kappa = [], 1.0
        for i in reversed(range(levels)):
            kappa = RECURSIVE[i] * kappa ** (i / (i + 1))
            gains.append(kappa * values['lipschitz'] ** ((levels - i) / levels))
        return {'structure': 'levant', 'variant': 'sign', 'scheme': scheme, 'lambda': gains}

    return parameters


def _levant_space(setting: Setting) -> list[Dimension]:
    return [Dimension('lipschitz', 1e-4 * setting.size, 1e8 * setting.size, 10.0 * setting.size)]


def _cascade_space(setting: Setting) -> list[Dimension]:
    levels = setting.model.order + 1
    names = [f'{name}_{i + 1}' for name in ('lambda', 'alpha', 'width') for i in range(levels)]
    return [
        Dimension('speed', 0.05, 5.0 / setting.period, 10.0),
        Dimension('kappa', 1e-3, 1e3, 3.0),
        Dimension('damping', 0.1, 10.0, 1.0),
        Dimension('gamma', 0.1, 1.0, 0.5),
        Dimension('epsilon', 1.0, 1e4, 100.0),
        *(Dimension(name, 0.03, 30.0, 1.0) for name in names),
    ]


def _cascade(scheme: str) -> Parameters:
    def parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
        """
        Gains by the rules of tools/tuning/theory.py, and a factor to each of them.

        A half-width covers, kappa times, what noise leaves in m_i and what lag leaves of it:
        with d of size D and a speed w that is noise sqrt(h w^(2i-1)) + D / w^(N-i).
        """
        speed, gamma = values['speed'], values['gamma']
        levels = setting.model.order + 1
        level = np.arange(1, levels + 1)

        def series(name: str) -> np.ndarray:
            return np.array([values[f'{name}_{i}'] for i in level])

        left = setting.noise * np.sqrt(setting.period * speed ** (2.0 * level - 1.0))
        left[0] = setting.noise
        width = values['kappa'] * (left + 0.1 * setting.size * speed ** (level - float(levels)))
        gain = 2.0 * values['damping'] * speed * width / (width / 3.0) ** gamma
        return {
            'variant': 'fuzzy_adaptive',
            'gamma_rate': 0.0,
            'gamma_initial': gamma,
            'scheme': scheme,
            'lambda': (series('lambda') * gain).clip(1e-12, 1e6),
            'alpha': (series('alpha') * speed**2 * width).clip(1e-12, 1e9),
            'fuzzy_widths': (series('width') * width).clip(1e-12, 1e12),
            'epsilon': values['epsilon'] * float(width.max()),
        }

    return parameters


def _none(setting: Setting) -> list[Dimension]:
    del setting
    return []


SLIDING = (
    Method(
        'Levant, explicit', "Levant's robust exact differentiator with Phi, explicit Euler",
        False, _levant_space, _prepare(_levant('explicit')),
    ),
    Method(
        'Levant, implicit', 'the same, implicit Euler', False, _levant_space,
        _prepare(_levant('implicit')),
    ),
    Method(
        'paper: sign', "sign observer with the paper's gains", False, _none,
        _prepare(_papers_gains('sign')),
    ),
    Method(
        'paper: fuzzy', "fuzzy observer with the paper's gains", False, _none,
        _prepare(_papers_gains('fuzzy')),
    ),
    Method(
        'paper: adaptive', "fuzzy observer with adapted gamma and the paper's gains", False, _none,
        _prepare(_papers_gains('fuzzy_adaptive')),
    ),
    Method(
        OURS, "the paper's cascade, fuzzy and explicit, every gain tuned", False, _cascade_space,
        _prepare(_cascade('explicit')),
    ),
)  # fmt: skip
