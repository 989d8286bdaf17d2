# SPDX-License-Identifier: Apache-2.0
"""
Our observer, and what is tuned of it.

The structure `levant` with the scheme `predict_correct`: for innovations far below the half-widths
a Kalman filter with a Matern model of d, beyond them a sliding mode. Theory gives gains for a
bandwidth (tools/tuning/start/theory.py). Searched are that bandwidth, the model of d, the
half-widths, and a factor for each gain and width.
"""

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

from fhaosmo_ros.core.observer.fuzzy import curves
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.tools.tuning.search.minimise import Dimension, minimise, StudyOptions
from fhaosmo_ros.tools.tuning.start.find import DERIVATIVES, SCHEME
from fhaosmo_ros.tools.tuning.start.sampled_model import SampledModel
from fhaosmo_ros.tools.tuning.start.theory import kalman_like
import numpy as np
from studies.comparison.methods.linear import matern_space
from studies.comparison.methods.method import Method, Setting, Values
from studies.comparison.methods.sliding import prepared

OURS = 'ours'
START_GAMMA = 3e-3
START_KAPPA = 300.0
SMALLEST_SPREAD, START_SPREAD = 1.6, 2.0
"""
Ratio of a level's half-width to the next one's. Gains that saturate all at once, by the same
factor, leave an unstable observer: three or more integrators are only conditionally stable. By
the describing functions of saturations, Butterworth's gains with this ratio or a larger one are
stable (N <= 7) for innovations up to four times the first half-width.
"""
KAPPAS = (8.0, 4.0, 2.0)
"""Half-widths to try, relative to the innovations that noise and start cause."""
FIRST_SHARE = 0.1
"""Of the trials: for bandwidth and decay alone, with each number of derivatives of d."""
NEAR = 3.0
"""How far the last search goes, as a factor to both sides."""
WORTH = 0.99
"""More parameters are taken only if the training error falls to this share; less is its noise."""


def _refined(setting: Setting, best: Values) -> list[Dimension]:
    """Return the dimensions of all parameters, near the best point so far."""
    levels = setting.model.order + 1 + int(best['derivatives'])
    factors = {f'lambda_{i + 1}': 1.0 for i in range(levels)}
    starts = {name: best[name] for name in ('bandwidth', 'decay')} | factors
    return [
        *(Dimension(name, x / NEAR, x * NEAR, x) for name, x in starts.items()),
        Dimension('spread', SMALLEST_SPREAD, 10.0, START_SPREAD),
        Dimension('kappa', 0.5, 1e4, best.get('kappa', START_KAPPA)),
        Dimension('gamma', SCHEME['gamma_min'], 1.0, best.get('gamma', START_GAMMA)),
    ]


def _space(setting: Setting) -> tuple[Dimension, ...]:
    """Return the dimensions without derivatives of d."""
    general = {d.name: d.start for d in matern_space(setting)}
    return tuple(_refined(setting, {'derivatives': 0.0} | general))


def _parameters(setting: Setting, values: Values) -> Mapping[str, Any]:
    derivatives = int(values.get('derivatives', 0))
    levels = setting.model.order + 1 + derivatives
    bandwidth, gamma = values['bandwidth'], values.get('gamma', START_GAMMA)
    # Wide enough for the start, whose innovations are about a period's worth of z_2's error.
    width = values.get('kappa', START_KAPPA) * (setting.noise + setting.size * setting.period)
    # Levels further from d saturate later, so that what is left of the gains is always stable.
    widths = width * values.get('spread', START_SPREAD) ** np.arange(levels - 1, -1, -1.0)
    small = max(setting.noise, 1e-3 * width)
    model = SampledModel(setting.model, setting.period, 1 + derivatives, decay=values['decay'])
    psi = curves(OBSERVER_PARAMETERS.defaults(), levels)
    gain = kalman_like(model, bandwidth, widths, psi, small, gamma)
    factors = np.array([values.get(f'lambda_{i + 1}', 1.0) for i in range(levels)])
    return {
        **SCHEME,
        'correction_period': setting.period,
        'prediction_step': model.resolution,
        'gamma_initial': gamma,
        'unknown_input_derivatives': derivatives,
        'unknown_input_decay': values['decay'],
        'lambda': (factors * gain).clip(1e-12, 1e15),
        'fuzzy_widths': widths.clip(1e-12, 1e12),
    }


class _Search:
    """Holds the best values so far, and the trials that are left."""

    def __init__(self, objective: Callable[[Values], float], trials: int, seed: int) -> None:
        self._objective, self._seed = objective, seed
        self.left = trials
        self.best: dict[str, float] = {}
        self._value = float('inf')

    def minimise(self, fixed: dict[str, float], space: list[Dimension], trials: int) -> None:
        trials = min(trials, self.left)
        if trials:
            self.left -= trials
            found = minimise(
                lambda v: self._objective(fixed | v),
                space,
                trials,
                StudyOptions(self._seed),
                jobs=1,
            )
            self._take(fixed | found.best, found.value)

    def try_out(self, values: dict[str, float]) -> None:
        if self.left:
            self.left -= 1
            self._take(values, self._objective(values))

    def _take(self, values: dict[str, float], value: float) -> None:
        if not self.best or value < WORTH * self._value:
            self.best, self._value = values, value


def _tune(
    objective: Callable[[Values], float], setting: Setting, trials: int, seed: int
) -> dict[str, float]:
    """Choose the number of derivatives, then the shape, then refine everything near the best."""
    search = _Search(objective, trials, seed)
    for k in DERIVATIVES:
        share = max(1, int(FIRST_SHARE * trials))
        search.minimise({'derivatives': float(k)}, list(matern_space(setting, k)), share)
    linear = search.best
    # Innovations that are cut off let the observer be faster: where there are outliers, as fast as
    # without them.
    speed, slow = setting.speed, linear['decay']
    starts = [(linear['bandwidth'], slow), (0.7 * speed, slow), (0.7 * speed, 2.0), (speed, 2.0)]
    orders = sorted({0.0, linear['derivatives']})
    for k, kappa, (bandwidth, decay) in product(orders, KAPPAS, starts):
        values = {'derivatives': k, 'kappa': kappa, 'bandwidth': bandwidth, 'decay': decay}
        search.try_out(values)
    fixed = {'derivatives': search.best['derivatives']}
    search.minimise(fixed, _refined(setting, search.best), search.left)
    return search.best


OUR_METHOD = Method(
    OURS,
    'levant, fuzzy, predict_correct, every gain and the model of d tuned',
    False,
    _space,
    prepared(_parameters),
    _tune,
)
