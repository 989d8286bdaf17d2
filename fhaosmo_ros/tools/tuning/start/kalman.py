# SPDX-License-Identifier: Apache-2.0
"""Gains of Kalman filters that may fit a sensor: where a search for `predict_correct` begins."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.fuzzy import curves
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.start.sampled_model import SampledModel
from fhaosmo_ros.tools.tuning.start.theory import effective_noise, kalman_like
import numpy as np

LEAST = 1e-30
"""Gain that stands for one that is not positive."""
FASTEST = 5.0
"""Bandwidth times period of a deadbeat observer."""
GAMMA = 3e-3
"""Power at which the injections are nearly linear in the innovation; the user may set another."""
RATES = tuple(float(x) for x in np.geomspace(0.1, 30.0, 8))
FACTORS = (0.8, 1.0, 1.25)
WIDTH = 16.0
"""Nearly linear for the noise itself, and outliers count as a few standard deviations of it."""
ZOOMS = (0.5, 0.25)
"""Distances to the neighbours that are tried around the best design, in steps of the grid."""


class KalmanDesign(NamedTuple):
    """
    One filter of the grid.

    Attributes
    ----------
    rate : float
        kappa of D 17 in 1/s: how fast d changes.
    factor : float
        Bandwidth, relative to the one that this d and the noise ask for.
    width : float
        Half-width of all levels, in units of the noise (without any: of y's change in a period).

    """

    rate: float
    factor: float
    width: float = WIDTH


def grid() -> list[KalmanDesign]:
    """Return the designs to evaluate first."""
    return [KalmanDesign(*pair) for pair in product(RATES, FACTORS)]


def around(design: KalmanDesign, zoom: float) -> Iterator[KalmanDesign]:
    """Yield the neighbours of a design, `zoom` steps of the grid away."""
    steps = [(x[1] / x[0]) ** zoom for x in (RATES, FACTORS)]
    for i, j in product((-1, 0, 1), repeat=2):
        if i or j:
            yield design._replace(
                rate=design.rate * steps[0] ** i, factor=design.factor * steps[1] ** j
            )


class KalmanGains:
    """
    Turns designs into parameters of the observer.

    Parameters
    ----------
    recordings : sequence of Recording
        With their truth, from which the sizes of d and of the noise follow.
    fixed : mapping
        Parameters of the observer that are set and not searched: `unknown_input_decay` and the
        first of `fuzzy_widths` replace those of a design; its fuzzy curves are theirs.
    model : TriangularModel
    derivatives : int
        Derivatives of d that the observer estimates.
    gamma : float
    least_noise : float
        Noise of y to assume where the recordings show less.

    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        fixed: Mapping[str, Any],
        model: TriangularModel,
        derivatives: int,
        gamma: float,
        least_noise: float = 0.0,
    ) -> None:
        self._fixed, self._model, self._derivatives = fixed, model, derivatives
        self._gamma = gamma
        self._period = float(np.median(np.diff(recordings[0].t)))
        states = np.concatenate([np.column_stack([r.z, r.d]) for r in recordings])
        size = np.sqrt(np.mean(np.square(states), axis=0))
        self._size = float(size[-1])
        # Without noise the fastest observer is deadbeat: this noise is too small to slow it down.
        least = 0.1 * self._size * self._period**model.order
        noise = max(effective_noise(recordings), least_noise)
        self._noise = max(noise, least)
        # Then the start has the largest innovations: what z_2 moves y by in a period.
        self._unit = noise if noise > least else max(float(size[1]) * self._period, least)

    def bandwidth(self, rate: float) -> float:
        """Return the bandwidth (rad/s) of the Kalman filter for a Matern d of this rate (D 17)."""
        k, levels = self._derivatives, self._model.order + 1 + self._derivatives
        scaled = self._size**2 * (2.0 * rate) ** (2 * k + 1) * math.factorial(k) ** 2
        intensity = scaled / math.factorial(2 * k)
        return float((intensity / (self._noise**2 * self._period)) ** (0.5 / levels))

    def __call__(self, design: KalmanDesign) -> dict[str, Any]:
        """
        Return the parameters of a design.

        Raises
        ------
        ConfigurationError
            There is no such filter.

        """
        decay = self._fixed.get('unknown_input_decay', design.rate)
        width = design.width * self._unit
        width = self._fixed.get('fuzzy_widths', [width])[0]
        bandwidth = min(design.factor * self.bandwidth(design.rate), FASTEST / self._period)
        small = max(self._noise, 1e-3 * width)
        try:
            model = SampledModel(self._model, self._period, 1 + self._derivatives, decay=decay)
        except np.linalg.LinAlgError as error:  # the model at rest has no finite slope
            raise ConfigurationError(f'Kalman gain: {error}') from None
        psi = curves(OBSERVER_PARAMETERS.defaults() | dict(self._fixed), model.size)
        gain = kalman_like(model, bandwidth, width, psi, small, self._gamma)
        return {
            'unknown_input_derivatives': self._derivatives,
            'unknown_input_decay': decay,
            'lambda': [float(x) for x in gain.clip(LEAST, OBSERVER_PARAMETERS['lambda'].upper)],
            'fuzzy_widths': [width] * len(gain),
            'gamma_initial': self._gamma,
        }
