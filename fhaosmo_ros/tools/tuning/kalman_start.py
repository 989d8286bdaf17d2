# SPDX-License-Identifier: Apache-2.0
"""Gains of the Kalman filters that may fit a sensor, for `predict_correct`: where it begins."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.family import Recording
from fhaosmo_ros.core.model import TriangularModel
from fhaosmo_ros.tools.sampled_model import SampledModel
from fhaosmo_ros.tools.tuning.theory import effective_noise, kalman_like
import numpy as np

FASTEST = 5.0
"""Bandwidth times period of a deadbeat observer."""
GAMMA = 3e-3
"""Small enough that the injections are linear in the innovation, unless the user sets one."""
RATES = tuple(float(x) for x in np.geomspace(0.1, 30.0, 8))
FACTORS = (0.8, 1.0, 1.25)
WIDTH = 3000.0
"""Where all levels saturate at once the observer may lose y: none does for usual innovations."""
NARROWER = (300.0, 30.0)
"""Taken where that pays: with outliers on y."""
ZOOMS = (0.5, 0.25)
"""Steps of the closer looks, in steps of the grid."""


class Point(NamedTuple):
    """
    One filter of the grid.

    Attributes
    ----------
    rate : float
        kappa of D 17, 1/s, in decades of the grid: what d is like.
    factor : float
        Bandwidth, relative to the one that this d and the noise ask for.
    width : float
        Half-width of all levels, in innovations that are usual at the start.

    """

    rate: float
    factor: float
    width: float = WIDTH


def grid() -> list[Point]:
    """Return the points to begin with."""
    return [Point(*pair) for pair in product(RATES, FACTORS)]


def around(point: Point, zoom: float) -> Iterator[Point]:
    """Yield the neighbours of a point, `zoom` steps of the grid away."""
    steps = [(x[1] / x[0]) ** zoom for x in (RATES, FACTORS)]
    for i, j in product((-1, 0, 1), repeat=2):
        if i or j:
            yield point._replace(
                rate=point.rate * steps[0] ** i, factor=point.factor * steps[1] ** j
            )


class KalmanStart:
    """
    Turns points of the grid into parameters of the observer.

    Parameters
    ----------
    recordings : sequence of Recording
        With their truth: the sizes of d, z_2 and the noise.
    fixed : mapping
        Parameters of the observer that are not open. Of what it makes, `gamma_initial`,
        `unknown_input_decay` and the first of `fuzzy_widths` are taken from here if there.
    model : TriangularModel
    derivatives : int
        Of d.
    gamma : float
    least_noise : float
        Of y, where the recordings have less.

    """

    def __init__(
        self, recordings: Sequence[Recording], fixed: Mapping[str, Any], model: TriangularModel,
        derivatives: int, gamma: float, least_noise: float = 0.0,
    ) -> None:  # fmt: skip
        self._fixed, self._model, self._derivatives = fixed, model, derivatives
        self._gamma = gamma
        self._period = float(np.median(np.diff(recordings[0].t)))
        states = np.concatenate([np.column_stack([r.z, r.d]) for r in recordings])
        size = np.sqrt(np.mean(np.square(states), axis=0))
        self._size = float(size[-1])
        # Without noise the observer may be deadbeat, and is not asked for more.
        least = 0.1 * self._size * self._period**model.order
        self._noise = max(effective_noise(recordings), least_noise, least)
        self._usual = self._noise + float(size[1]) * self._period

    def bandwidth(self, rate: float) -> float:
        """Return the Kalman filter's (rad/s) for a Matern d of its size and this rate (D 17)."""
        k, levels = self._derivatives, self._model.order + 1 + self._derivatives
        intensity = (
            self._size**2 * (2.0 * rate) ** (2 * k + 1)
            * math.factorial(k) ** 2 / math.factorial(2 * k)
        )  # fmt: skip
        return float((intensity / (self._noise**2 * self._period)) ** (0.5 / levels))

    def __call__(self, point: Point) -> dict[str, Any]:
        """
        Return the parameters at a point.

        Raises
        ------
        ConfigurationError
            There is no such filter.

        """
        decay = self._fixed.get('unknown_input_decay', point.rate)
        width = point.width * self._usual
        width = self._fixed.get('fuzzy_widths', [width])[0]
        bandwidth = min(point.factor * self.bandwidth(point.rate), FASTEST / self._period)
        small = max(self._noise, 1e-3 * width)
        try:
            model = SampledModel(self._model, self._period, 1 + self._derivatives, decay=decay)
        except np.linalg.LinAlgError as error:  # at rest the model is not even finite
            raise ConfigurationError(f'Kalman gain: {error}') from None
        gain = kalman_like(model, bandwidth, width, small, self._gamma)
        return {
            'unknown_input_derivatives': self._derivatives,
            'unknown_input_decay': decay,
            'lambda': [float(x) for x in gain.clip(1e-12, 1e15)],
            'fuzzy_widths': [width] * len(gain),
            'gamma_initial': self._gamma,
        }
