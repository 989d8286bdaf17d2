# SPDX-License-Identifier: Apache-2.0
"""A Kalman filter with a Matern model of d, also with Huber weights, also with a loss test."""

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.prediction import Prediction
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.kalman import stationary
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from studies.comparison.methods.filters import with_faults

Floats = NDArray[np.float64]
LONGEST = 1.5e-3
"""Steps of the prediction are shorter than this (s)."""


class Samples(NamedTuple):
    """Samples as `with_faults` takes them."""

    y: Floats
    h: Floats
    u: Floats
    which: NDArray[np.int64]
    outliers: Floats


class Model(NamedTuple):
    """What P follows, as `with_faults` takes it."""

    a: Floats
    q: Floats
    fresh: Floats
    variance: float
    huber: float
    lost: bool


class KalmanFilter:
    """
    Linearised at rest; the prediction integrates the whole model.

    Parameters
    ----------
    estimator : mapping
        `order`, `phi`.
    decay, derivatives : float, int
        Of the model of d (D 17).
    noise, size : float
        Standard deviations of the noise on y and of d.

    """

    def __init__(
        self, estimator: Mapping[str, Any], decay: float, derivatives: int, noise: float,
        size: float,
    ) -> None:  # fmt: skip
        model = TriangularModel(estimator['phi'], estimator['order'])
        n, k = model.order, derivatives
        self._n, total = n, n + 1 + k
        self._noise = noise
        rates = np.eye(total, k=1)
        rates[:n, :n] += model.jacobian(np.zeros(n))
        rates[range(n, total), range(n, total)] = -decay
        q = size**2 * (2 * decay) ** (2 * k + 1) * math.factorial(k) ** 2 / math.factorial(2 * k)
        drive = np.zeros((total, total))
        drive[-1, -1] = q
        self._rates, self._drive = rates, drive
        self._prior = np.zeros((total, total))
        self._prior[n:, n:] = stationary(rates[n:, n:], q)
        self._prior[range(1, n), range(1, n)] = np.square(
            estimator.get('state_sizes', [max(size, 1.0)] * n)[1:]
        )
        self._prior[0, 0] = noise**2
        self._prediction = Prediction(model.with_unknown_input(decay, k), LONGEST)

    def run(
        self, t: Floats, y: Floats, huber: float = math.inf, lost: bool = False,
        outliers: Floats | None = None,
    ) -> Floats:  # fmt: skip
        """Return the estimates of d; samples where `outliers` is 1 are left out."""
        total = len(self._rates)
        periods = np.round(np.diff(t, prepend=t[0]), 7)
        different, which = np.unique(periods, return_inverse=True)
        a, q = np.zeros((2, len(different), total, total))
        for i, h in enumerate(different):
            block = np.zeros((2 * total, 2 * total))
            block[:total, :total], block[total:, total:] = -self._rates, self._rates.T
            block[:total, total:] = self._drive
            e = expm(block * h)
            a[i] = e[total:, total:].T
            q[i] = a[i] @ e[:total, total:]
        if outliers is None:
            outliers = np.zeros(len(y))
        u = np.zeros((len(y), 1))
        samples = Samples(y, np.diff(t, prepend=t[0]), u, which.astype(np.int64), outliers)
        model = Model(a, q, self._prior, self._noise**2, huber, lost)
        return np.ascontiguousarray(with_faults(self._prediction, samples, model)[:, self._n])
