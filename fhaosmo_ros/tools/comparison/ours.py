# SPDX-License-Identifier: Apache-2.0
"""Our observer, and what is tuned of it: gains by the rules of theory, times a factor each."""

from collections.abc import Callable, Mapping
from math import comb
from typing import Any

from fhaosmo_ros.tools.comparison.methods import Method, Setting, Values
from fhaosmo_ros.tools.comparison.sliding import Parameters, prepared
from fhaosmo_ros.tools.tuning.search import Dimension
import numpy as np
from numpy.typing import NDArray

OURS = 'ours'
SMALLEST_GAMMA = 1e-4
Space = Callable[[Setting], list[Dimension]]


def _space(factors: tuple[str, ...], gamma: float, epsilon: bool) -> Space:
    def space(setting: Setting) -> list[Dimension]:
        levels = setting.model.order + 1
        names = [f'{name}_{i + 1}' for name in factors for i in range(levels)]
        general = [
            Dimension('speed', 0.05, 5.0 / setting.period, setting.speed),
            Dimension('kappa', 1e-3, 1e3, 3.0),
            Dimension('gamma', 10.0 * SMALLEST_GAMMA, 1.0, gamma),
            Dimension('decay', 1e-3, 1e2, 0.1),
        ]
        if epsilon:
            general.append(Dimension('epsilon', 1.0, 1e4, 100.0))
        return general + [Dimension(name, 0.03, 30.0, 1.0) for name in names]

    return space


def _widths(setting: Setting, values: Values) -> NDArray[np.float64]:
    """
    Return half-widths: kappa times what noise leaves in m_i, and what lag leaves of it.

    With d of size D and a speed w that is noise sqrt(h w^(2i-1)) + D / w^(N-i); see
    tools/tuning/theory.py.
    """
    level = np.arange(1, setting.model.order + 2)
    left = setting.noise * np.sqrt(setting.period * values['speed'] ** (2.0 * level - 1.0))
    left[0] = setting.noise
    lag = 0.1 * setting.size * values['speed'] ** (level - float(len(level)))
    return np.asarray(values['kappa'] * (left + lag))


def _series(values: Values, name: str, setting: Setting) -> NDArray[np.float64]:
    return np.array([values[f'{name}_{i + 1}'] for i in range(setting.model.order + 1)])


def _common(values: Values, scheme: str) -> dict[str, Any]:
    return {
        'variant': 'fuzzy_adaptive',
        'gamma_rate': 0.0,
        'gamma_initial': values['gamma'],
        'gamma_min': SMALLEST_GAMMA,
        'scheme': scheme,
        'unknown_input_decay': values['decay'],
    }


def _cascade(scheme: str) -> Parameters:
    def parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
        speed, gamma = values['speed'], values['gamma']
        width = _widths(setting, values)
        gain = 2.0 * speed * width / (width / 3.0) ** gamma
        return _common(values, scheme) | {
            'lambda': (_series(values, 'lambda', setting) * gain).clip(1e-12, 1e6),
            'alpha': (_series(values, 'alpha', setting) * speed**2 * width).clip(1e-12, 1e9),
            'fuzzy_widths': (_series(values, 'width', setting) * width).clip(1e-12, 1e12),
            'epsilon': values['epsilon'] * float(width.max()),
        }

    return parameters


def _levant(scheme: str) -> Parameters:
    def parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
        """Gains whose poles lie at the speed for innovations of a third of the half-width."""
        levels = setting.model.order + 1
        width = _widths(setting, values)[0]
        level = np.arange(1, levels + 1)
        power = 2.0 * values['gamma'] * (levels - level) / levels
        poles = np.array([comb(levels, int(i)) for i in level]) * values['speed'] ** level
        gain = poles * width / (width / 3.0) ** power
        return _common(values, scheme) | {
            'structure': 'levant',
            'lambda': (_series(values, 'lambda', setting) * gain).clip(1e-12, 1e6),
            'fuzzy_widths': (_series(values, 'width', setting) * width).clip(1e-12, 1e12),
        }

    return parameters


def variant(structure: str, scheme: str) -> Method:
    """Return our observer with one structure ('cascade' or 'levant') and scheme."""
    parameters = {'cascade': _cascade, 'levant': _levant}[structure](scheme)
    space = (
        _space(('lambda', 'alpha', 'width'), 0.5, epsilon=True)
        if structure == 'cascade'
        else _space(('lambda', 'width'), 0.25, epsilon=False)
    )
    return Method(
        OURS, f'{structure}, fuzzy, {scheme}, every gain tuned', False, space, prepared(parameters)
    )


OUR_METHOD = variant('levant', 'implicit')
