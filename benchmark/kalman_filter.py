# SPDX-License-Identifier: Apache-2.0
"""A Kalman filter with a Matern model of d, also with Huber weights, also with a loss test."""

from collections.abc import Mapping
import math
from typing import Any

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Bytecode
from fhaosmo_ros.core.model.integrate import (
    begin_step,
    CLASSICAL,
    NOW,
    take_slope,
    triangular_rates,
)
from fhaosmo_ros.core.model.triangular import TriangularModel
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

Floats = NDArray[np.float64]
GATE, MOST = 12.0, 20


@compiled()
def _run(
    model: Bytecode, stack: Floats, stages: Floats, t: Floats, y: Floats, which: Floats,
    transitions: Floats, prior: Floats, settings: Floats, outliers: Floats, out: Floats,
) -> None:  # fmt: skip
    """Filter; `transitions` holds A and Q of each different interval, `which` chooses them."""
    n, r, huber, lost = prior.shape[0], settings[0], settings[1], settings[2] > 0.0
    p, x, beyond, u = prior.copy(), stages[NOW, 0], 0, np.zeros(1)
    x[:] = 0.0
    x[0] = y[0]
    out[0] = 0.0
    for k in range(1, len(y)):
        a, q = transitions[0, int(which[k])], transitions[1, int(which[k])]
        steps = int((t[k] - t[k - 1]) / 1.5e-3) + 1
        for _ in range(steps):
            begin_step(stages)
            for stage in range(4):
                triangular_rates(model, 0.0, u, stack, stages)
                take_slope(CLASSICAL, stage, (t[k] - t[k - 1]) / steps, stages)
        p = a @ p @ a.T + q
        b, s = y[k] - x[0], p[0, 0] + r
        skip = outliers[k] > 0.0
        if lost:
            beyond = beyond + 1 if abs(b) > GATE * math.sqrt(s) else 0
            skip = beyond > 0
            if beyond > MOST:
                p, beyond = prior.copy(), 0
                x[:] = 0.0
                x[0] = y[k]
                skip = True
        if not skip:
            rr = r
            if huber > 0.0 and abs(b) > huber * math.sqrt(s):
                rr = r + s * (abs(b) / (huber * math.sqrt(s)) - 1.0)
            gain = p[:, 0] / (p[0, 0] + rr)
            x += gain * b
            keep = np.eye(n)
            keep[:, 0] -= gain
            p = keep @ p @ keep.T + rr * np.outer(gain, gain)
        out[k] = x[int(settings[3])]


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
        self._model = TriangularModel(estimator['phi'], estimator['order'])
        n, k = self._model.order, derivatives
        self._n, total = n, n + 1 + k
        self._noise = noise
        rates = np.eye(total, k=1)
        rates[:n, :n] += self._model.jacobian(np.zeros(n))
        rates[range(n, total), range(n, total)] = -decay
        q = size**2 * (2 * decay) ** (2 * k + 1) * math.factorial(k) ** 2 / math.factorial(2 * k)
        drive = np.zeros((total, total))
        drive[-1, -1] = q
        self._rates, self._drive = rates, drive
        chain = rates[n:, n:]
        self._prior = np.zeros((total, total))
        self._prior[n:, n:] = solve_continuous_lyapunov(chain, -drive[n:, n:])
        self._prior[range(1, n), range(1, n)] = np.square(
            estimator.get('state_sizes', [max(size, 1.0)] * n)[1:]
        )
        self._prior[0, 0] = noise**2
        self._expressions = self._model.with_unknown_input(decay, k)

    def run(
        self, t: Floats, y: Floats, huber: float = 0.0, lost: bool = False,
        outliers: Floats | None = None,
    ) -> Floats:  # fmt: skip
        """Return the estimates of d; samples where `outliers` is 1 are left out."""
        total = len(self._rates)
        periods = np.round(np.diff(t, prepend=t[0]), 7)
        different, which = np.unique(periods, return_inverse=True)
        transitions = np.zeros((2, len(different), total, total))
        for i, h in enumerate(different):
            block = np.zeros((2 * total, 2 * total))
            block[:total, :total], block[total:, total:] = -self._rates, self._rates.T
            block[:total, total:] = self._drive
            e = expm(block * h)
            transitions[0, i] = e[total:, total:].T
            transitions[1, i] = transitions[0, i] @ e[:total, total:]
        out = np.zeros((len(t), 1))
        settings = np.array([self._noise**2, huber, float(lost), self._n])
        stack, stages = np.zeros((2, self._model.depth)), np.zeros((4, 2, total))
        _run(
            self._expressions, stack, stages, t, y, which.astype(float), transitions, self._prior,
            settings, np.zeros(len(y)) if outliers is None else outliers, out,
        )  # fmt: skip
        return out[:, 0]
