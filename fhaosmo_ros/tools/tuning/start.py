# SPDX-License-Identifier: Apache-2.0
"""
Where a search begins: the observer that is the best Kalman filter for the recordings (D 19).

How fast d changes, how many of its derivatives to follow, and a factor on the bandwidth are tried;
the sizes of d and of the noise are those of the recordings. Other schemes than `SCHEME` begin with
the user's gains, or the default ones.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
import math
from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import FIXED_GAMMA
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.cli.progress import progress
from fhaosmo_ros.tools.tuning.linear_gains import kalman_gains, matern
from fhaosmo_ros.tools.tuning.objective import Objective
import numpy as np
from numpy.typing import NDArray

SCHEME: Mapping[str, Any] = {
    'structure': 'levant',
    'scheme': 'predict_correct',
    'variant': 'fuzzy_adaptive',
    'gamma_rate': 0.0,
    'gamma_min': 1e-4,
}
"""What is tuned where the user sets no other structure or scheme."""
MEANT_FOR = ('lambda', 'alpha', 'epsilon', 'initial_internal')
"""A user who sets one of these has chosen structure and scheme: such values fit one of them."""
DERIVATIVES = (0, 1, 2, 3)
WORTH = 0.99
"""One more derivative of d must reduce the objective to this part of it."""
HOPELESS = 1.3
"""Numbers of derivatives that are this factor behind the best on the grid are given up."""
FASTEST = 5.0
"""Bandwidth times period of a deadbeat observer."""
GAMMA = 3e-3
"""Power at which the injections are nearly linear in the innovation; the user may set another."""
RATES, FACTORS = np.geomspace(0.1, 30.0, 8), np.array([0.8, 1.0, 1.25])
"""kappa of D 17 (1/s), and the bandwidth relative to the one that this d and the noise ask for."""
WIDTH = 16.0
"""Nearly linear for the noise itself, and outliers count as a few standard deviations of it."""
ZOOMS = (0.5, 0.25)
"""Distances to the neighbours that are tried around the best filter, in steps of the grid."""
Gains, Point = dict[str, Any], tuple[float, float]


def chosen_otherwise(estimator: Mapping[str, Any]) -> list[str]:
    """Return the parameters, as set by the user, that ask for something else than `SCHEME`."""
    found = [k for k in ('structure', 'scheme') if estimator.get(k, SCHEME[k]) != SCHEME[k]]
    if not estimator.get('unknown_input', True):
        found.append('unknown_input')
    return found + [k for k in MEANT_FOR if k in estimator]


def with_scheme(estimator: Mapping[str, Any], recordings: Sequence[Recording]) -> Gains:
    """
    Return what the user set for the estimator, with `SCHEME` where that is open.

    The sizes of the noise, of the states and of d are those of the recordings. Without noise on y
    they are left out: nothing says how sure the observer is.
    """
    given = dict(estimator)
    if chosen_otherwise(given):
        return given
    period = float(f'{np.median(np.diff(recordings[0].t)):.4g}')
    noise, sizes = effective_noise(recordings), true_sizes(recordings)
    known = {}
    if noise > 0.0 and (sizes > 0.0).all():
        z, d = [float(f'{x:.3g}') for x in sizes[:-1]], float(f'{sizes[-1]:.3g}')
        known = {'noise_size': float(f'{noise:.3g}'), 'state_sizes': z, 'unknown_input_size': d}
    return {**SCHEME, 'correction_period': period, **known, **given}


def find_start(
    recordings: Sequence[Recording],
    estimator: Mapping[str, Any],
    names: Sequence[str],
    objective: Callable[[Mapping[str, Any]], Objective],
    jobs: int,
    stopped: Callable[[], bool],
) -> tuple[Gains, dict[int, float]]:
    """
    Evaluate Kalman filters, and return the best one.

    Parameters
    ----------
    recordings : sequence of Recording
    estimator : mapping
        What is set for the estimator, with the scheme; see `with_scheme`.
    names : sequence of str
        Parameters that are searched.
    objective : callable
        From what is set for the estimator to an Objective.
    jobs : int
        Threads.
    stopped : callable
        Asked before each evaluation; True ends the search with the best so far.

    Returns
    -------
    gains : dict
        Parameters of the observer: those that are searched, and those that fit them.
    tried : dict
        Best objective by number of derivatives of d. Both are empty where no filter fits.

    """
    p = Observer(ESTIMATOR_PARAMETERS.complete(estimator)).parameters
    if p['scheme'] != 'predict_correct' or not p['variant'].startswith('fuzzy'):
        return {}, {}
    gamma = FIXED_GAMMA
    if p['variant'].endswith('_adaptive'):
        gamma = p['gamma_initial']
        if 'gamma_initial' in names and 'gamma_initial' not in estimator:
            gamma = min(max(GAMMA, p['gamma_min']), p['gamma_max'])
    fixed = {k: v for k, v in estimator.items() if k not in names}
    open_ = not {'unknown_input_derivatives', 'lambda'} & estimator.keys()
    orders = DERIVATIVES if open_ else [p['unknown_input_derivatives']]
    filters = {k: KalmanStart(recordings, fixed, p, k, gamma) for k in orders}
    judges = {k: objective({**estimator, 'unknown_input_derivatives': k}) for k in orders}
    with ThreadPoolExecutor(jobs) as pool, progress(unit='set', desc='start', leave=False) as bar:

        def best(k: int, points: Iterable[Point]) -> tuple[float, Point]:
            """Return the smallest objective, and its rate and factor."""

            def evaluate(point: Point) -> tuple[float, Point]:
                bar.update()
                try:
                    value = math.inf if stopped() else judges[k](filters[k](*point)).objective
                except ConfigurationError:  # a value out of its bounds, or values that do not fit
                    value = math.inf
                return value, point

            return min(pool.map(evaluate, points))

        found = {k: best(k, product(RATES, FACTORS)) for k in orders}
        limit = HOPELESS * min(value for value, _ in found.values())
        for k, zoom in product(orders, ZOOMS):
            if found[k][0] <= limit:
                rate, factor = found[k][1]
                a, b = ((x[1] / x[0]) ** zoom for x in (RATES, FACTORS))
                near = product((rate / a, rate, rate * a), (factor / b, factor, factor * b))
                found[k] = min(found[k], best(k, near))
    tried = {k: value for k, (value, _) in found.items()}
    least = min(tried.values())
    if math.isinf(least):
        return {}, {}
    chosen = next(k for k, value in tried.items() if WORTH * value <= least)
    return filters[chosen](*found[chosen][1]), tried


class KalmanStart:
    """
    Makes parameters of the observer that is a Kalman filter.

    Parameters
    ----------
    recordings : sequence of Recording
        With their truth, from which the sizes of d and of the noise follow.
    fixed : mapping
        Parameters that are set and not searched: `unknown_input_decay` and the first of
        `fuzzy_widths` replace those of a filter.
    p : mapping
        Of the observer, complete.
    derivatives : int
        Derivatives of d that the observer estimates.
    gamma : float

    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        fixed: Mapping[str, Any],
        p: Mapping[str, Any],
        derivatives: int,
        gamma: float,
    ) -> None:
        self._fixed, self._derivatives, self._gamma = fixed, derivatives, gamma
        self._p, self._model = p, TriangularModel.of(p)
        self._levels = self._model.order + 1 + derivatives
        self._period = float(np.median(np.diff(recordings[0].t)))
        size = true_sizes(recordings)
        self._size = float(size[-1])
        # Without noise the fastest observer is deadbeat: this noise is too small to slow it down.
        least = 0.1 * self._size * self._period**self._model.order
        noise = effective_noise(recordings)
        self._noise = max(noise, least)
        # Then the start has the largest innovations: what z_2 moves y by in a period.
        unit = noise if noise > least else max(float(size[1]) * self._period, least)
        self._width = fixed.get('fuzzy_widths', [WIDTH * unit])[0]

    def bandwidth(self, rate: float) -> float:
        """Return the bandwidth (rad/s) of the Kalman filter for a Matern d of this rate (D 17)."""
        intensity = self._size**2 * matern(rate, self._derivatives)
        return float((intensity / (self._noise**2 * self._period)) ** (0.5 / self._levels))

    def __call__(self, rate: float, factor: float) -> Gains:
        """
        Return the parameters of a filter; see `RATES` and `FACTORS`.

        Raises
        ------
        ConfigurationError
            There is no such filter.

        """
        decay = self._fixed.get('unknown_input_decay', float(rate))
        bandwidth = min(factor * self.bandwidth(rate), FASTEST / self._period)
        intensity = self._noise**2 * self._period * bandwidth ** (2 * self._levels)
        unit = matern(decay or self._p['unknown_input_rate'], self._derivatives)
        asked = {
            'noise_size': self._noise,
            'unknown_input_size': math.sqrt(intensity / unit),
            'unknown_input_derivatives': self._derivatives,
            'unknown_input_decay': decay,
            'fuzzy_widths': [self._width] * self._levels,
            'gamma_initial': self._gamma,
        }
        found = kalman_gains(self._model, dict(self._p) | asked, self._period)
        shown = {k: v for k, v in asked.items() if not k.endswith('_size')}
        return shown | {'lambda': found.lambdas.tolist()}


def true_sizes(recordings: Sequence[Recording]) -> NDArray[np.float64]:
    """Return the RMS values of z and d over recordings."""
    chain = np.concatenate([np.column_stack([r.z, r.d]) for r in recordings])
    return np.asarray(np.sqrt(np.mean(np.square(chain), axis=0)))


def effective_noise(recordings: Sequence[Recording]) -> float:
    """Return the RMS of y - z_1: noise, quantum and, where z_1 is at the stamps, jitter."""
    return _rms(np.concatenate([r.y - r.z[:, 0] for r in recordings]))


def _rms(x: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
