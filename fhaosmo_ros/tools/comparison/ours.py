# SPDX-License-Identifier: Apache-2.0
"""
Our observer, and what is tuned of it.

The structure `levant` with the scheme `predict_correct`: for innovations far below the half-widths
a Kalman filter with a Matern model of d, beyond them a sliding mode. Theory gives gains for a
bandwidth (tools/tuning/theory.py). Searched are that bandwidth, the model of d, the half-widths,
and a factor for each gain and width.
"""

from collections.abc import Callable, Mapping
from typing import Any

from fhaosmo_ros.tools.comparison.methods import Method, Setting, Values
from fhaosmo_ros.tools.comparison.sliding import prepared
from fhaosmo_ros.tools.sampled_model import SampledModel
from fhaosmo_ros.tools.tuning.search import Dimension, minimise
from fhaosmo_ros.tools.tuning.theory import kalman_like
import numpy as np

OURS = 'ours'
DERIVATIVES = (0, 1, 2, 3)
SMALLEST_GAMMA = 1e-4
START_GAMMA = 3e-3
START_KAPPA = 300.0
FIRST_SHARE = 0.1
WORTH = 0.99
"""More parameters have to bring at least this factor on the training, or they fit its noise."""
REACH, NEAR = 30.0, 3.0
"""Factors to both sides of a start: of the first searches, and of the last one."""
"""Of the trials: for bandwidth and decay alone, with each number of derivatives of d."""


def _general(setting: Setting) -> list[Dimension]:
    """Return what matters most: how fast, and what d is like."""
    speed, fastest = setting.speed, 5.0 / setting.period
    return [
        Dimension('bandwidth', speed / REACH, min(speed * REACH, fastest), speed),
        Dimension('decay', 1e-3, 1e2, 0.3),
    ]


def _refined(setting: Setting, best: Values) -> list[Dimension]:
    """Return everything, near the best point so far."""
    levels = setting.model.order + 1 + int(best['derivatives'])
    factors = {f'{name}_{i + 1}': 1.0 for name in ('lambda', 'width') for i in range(levels)}
    starts = {name: best[name] for name in ('bandwidth', 'decay')} | factors
    return [
        *(Dimension(name, x / NEAR, x * NEAR, x) for name, x in starts.items()),
        Dimension('kappa', 0.1, 1e4, START_KAPPA),
        Dimension('gamma', SMALLEST_GAMMA, 1.0, START_GAMMA),
    ]


def _space(setting: Setting) -> tuple[Dimension, ...]:
    """Return what is tuned at least: with d as it is, without derivatives."""
    general = {d.name: d.start for d in _general(setting)}
    return tuple(_refined(setting, {'derivatives': 0.0} | general))


def _series(values: Values, name: str, levels: int) -> np.ndarray:
    return np.array([values.get(f'{name}_{i + 1}', 1.0) for i in range(levels)])


def _parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
    derivatives = int(values.get('derivatives', 0))
    levels = setting.model.order + 1 + derivatives
    bandwidth, gamma = values['bandwidth'], values.get('gamma', START_GAMMA)
    # Wide enough for the start, whose innovations are about a period's worth of z_2's error.
    width = values.get('kappa', START_KAPPA) * (setting.noise + setting.size * setting.period)
    small = max(setting.noise, 1e-3 * width)
    model = SampledModel(setting.model, setting.period, 1 + derivatives, decay=values['decay'])
    gain = kalman_like(model, bandwidth, width, small, gamma)
    return {
        'structure': 'levant',
        'scheme': 'predict_correct',
        'correction_period': setting.period,
        'variant': 'fuzzy_adaptive',
        'gamma_rate': 0.0,
        'gamma_initial': gamma,
        'gamma_min': SMALLEST_GAMMA,
        'unknown_input_derivatives': derivatives,
        'unknown_input_decay': values['decay'],
        'lambda': (_series(values, 'lambda', levels) * gain).clip(1e-12, 1e15),
        'fuzzy_widths': (_series(values, 'width', levels) * width).clip(1e-12, 1e12),
    }


def _tune(
    objective: Callable[[Values], float], setting: Setting, trials: int, seed: int
) -> dict[str, float]:
    """Choose the number of derivatives, then refine everything from the best point so far."""
    each = max(1, int(FIRST_SHARE * trials))
    best, value = {'derivatives': 0.0}, float('inf')
    for derivatives in DERIVATIVES:
        best, value = _better(
            objective, {'derivatives': float(derivatives)}, _general(setting), each, seed,
            best, value,
        )  # fmt: skip
    rest = trials - each * len(DERIVATIVES)
    if rest > 0:
        fixed = {'derivatives': best['derivatives']}
        best, value = _better(objective, fixed, _refined(setting, best), rest, seed, best, value)
    return best


def _better(
    objective: Callable[[Values], float], fixed: dict[str, float], space: list[Dimension],
    trials: int, seed: int, best: dict[str, float], value: float,
) -> tuple[dict[str, float], float]:  # fmt: skip
    found = minimise(lambda v: objective(fixed | v), space, trials, seed=seed, jobs=1)
    return (fixed | found.best, found.value) if found.value < WORTH * value else (best, value)


OUR_METHOD = Method(
    OURS, 'levant, fuzzy, predict_correct, every gain and the model of d tuned', False,
    _space, prepared(_parameters), _tune,
)  # fmt: skip
