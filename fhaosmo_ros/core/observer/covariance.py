# SPDX-License-Identifier: Apache-2.0
"""
How far off the estimates may be, and the gains and the test of y that follow from it.

The covariance P of the errors follows the Kalman filter of the model, linearised at rest, with a
Matern model of d (D 17, D 20). It begins with the sizes of the states, of d and of the noise that
parameters tell. Equations are cited by their numbers in docs/mathematics.md (D).

The compiled functions work on P in the last rows of ``work.x``.
"""

from collections.abc import Mapping
import math
from typing import Any

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.integrate import SLOPE, TOTAL
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.arrays import COVARIANCE, FASTEST, INTENSITY, Law, VARIANCE, Work
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
RATES, STEADY, FRESH = range(3)
"""Parts of `Law.chances`, of N rows each."""
STEP = 0.5
"""Part of the time constant of the fastest motion that one step of the covariance may take."""
MOST_STEPS = 100
DOUBLINGS = 60
DECIDING = (
    'noise_size', 'unknown_input_size', 'unknown_input_rate', 'unknown_input_decay',
    'correction_period', 'structure', 'scheme', 'phi',
)  # fmt: skip
"""Parameters that decide whether there is a steady covariance."""


@compiled()
def predict_covariance(law: Law, work: Work, h: float) -> None:
    """P <- Phi P Phi' + Q over `h` (D 20), in place."""
    n = law.gains.shape[1]
    count = int(min(math.ceil(h * law.scalars[FASTEST] / STEP), MOST_STEPS))
    count = max(count, 1)
    h /= count
    p, power = work.x, work.stages[TOTAL]
    for _ in range(count):
        for j in range(n):  # columns, then rows
            _carry(law, work, h, j, True)
        for i in range(n):
            _carry(law, work, h, i, False)
        power[0, n - 1] = 1.0
        for i in range(n - 1, 0, -1):
            power[0, i - 1] = power[0, i] * h / (n - i)
        for i in range(n):  # white noise through a chain of integrators (Van Loan 1978)
            for j in range(n):
                q = power[0, i] * power[0, j] / (2 * n - 1 - i - j)
                p[COVARIANCE + i, j] += law.scalars[INTENSITY] * h * q


@compiled()
def _carry(law: Law, work: Work, h: float, k: int, column: bool) -> None:
    """Multiply a column (or row) of P by exp(A h), by the first N terms of its series."""
    n, p, x, term = law.gains.shape[1], work.x, work.stages[TOTAL], work.stages[SLOPE]
    for i in range(n):
        x[0, i] = p[COVARIANCE + i, k] if column else p[COVARIANCE + k, i]
        term[0, i] = x[0, i]
    for order in range(1, n + 1):
        for i in range(n):
            total = 0.0
            for j in range(min(i + 2, n)):  # A is a lower Hessenberg matrix
                total += law.chances[i, j] * term[0, j]
            term[1, i] = total * h / order
        for i in range(n):
            term[0, i] = term[1, i]
            x[0, i] += term[1, i]
    for i in range(n):
        if column:
            p[COVARIANCE + i, k] = x[0, i]
        else:
            p[COVARIANCE + k, i] = x[0, i]


@compiled()
def correct_covariance(law: Law, work: Work) -> None:
    """Take a sample into P (D 20), in place."""
    n, p, variance = law.gains.shape[1], work.x, law.scalars[VARIANCE]
    s = p[COVARIANCE, 0] + variance
    for i in range(1, n):
        for j in range(i, n):
            p[COVARIANCE + i, j] -= p[COVARIANCE, i] * p[COVARIANCE, j] / s
            p[COVARIANCE + j, i] = p[COVARIANCE + i, j]
    for j in range(n):
        p[COVARIANCE, j] *= variance / s
        p[COVARIANCE + j, 0] = p[COVARIANCE, j]


class Uncertainty:
    """
    What the covariance recursion needs, from parameters.

    Parameters
    ----------
    model : TriangularModel
    p : mapping
        Parameters of the observer, with noise_size > 0.
    sizes : (n,) array
        Of the states.

    Attributes
    ----------
    rates : (N, N) array
        A of the model with D 17, linearised at rest.
    intensity : float
        Of the white noise that drives the last level.
    fresh : (N, N) array
        Covariance of the errors of a fresh observer.

    Raises
    ------
    ConfigurationError
        The model has no finite slope at rest.

    """

    def __init__(self, model: TriangularModel, p: Mapping[str, Any], sizes: Matrix) -> None:
        n, k = model.order, p['unknown_input_derivatives']
        size, decay = p['unknown_input_size'], p['unknown_input_decay']
        levels = n + 1 + k
        jacobian = model.jacobian(np.zeros(n))
        if not np.isfinite(jacobian).all():
            raise ConfigurationError(
                "parameters 'noise_size', 'phi': expected a model whose slopes at z = 0 are "
                f'finite, or noise_size = 0, got {jacobian.tolist()}'
            )
        rates = np.eye(levels, k=1)
        rates[:n, :n] += jacobian
        rates[range(n, levels), range(n, levels)] = -decay
        self.rates, self.order = rates, n
        rate = decay or p['unknown_input_rate']
        factor = (2.0 * rate) ** (2 * k + 1) * math.factorial(k) ** 2 / math.factorial(2 * k)
        self.variance, self.intensity = p['noise_size'] ** 2, size**2 * factor
        self.fresh = np.zeros((levels, levels))
        self.fresh[range(n), range(n)] = np.square(sizes)
        if p['start_from_measurement']:
            self.fresh[0, 0] = self.variance
        chain = np.eye(k + 1, k=1) - rate * np.eye(k + 1)
        self.fresh[n:, n:] = stationary(chain, self.intensity)

    @property
    def fastest(self) -> float:
        """The rate (1/s) of the model's fastest motion."""
        return float(np.abs(np.linalg.eigvals(self.rates)).max())

    def steady(self, period: float) -> Matrix:
        """
        Return the covariance of the errors of the predictions once P has become steady.

        By the structure-preserving doubling algorithm (Chu, Fan, Lin and Wang 2004,
        doi:10.1080/00207170410001714988), in units in which the filter has a bandwidth of 1.

        Raises
        ------
        ConfigurationError
            There is no such covariance in floating-point numbers.

        """
        n = len(self.rates)
        speed = (self.intensity / (self.variance * period)) ** (0.5 / n)
        unit = math.sqrt(self.variance) * speed ** np.arange(n)
        phi, q = transition(self.rates, self.intensity, period)
        a = (phi * unit[None, :] / unit[:, None]).T
        h = q / np.outer(unit, unit)
        g = np.zeros((n, n))
        g[0, 0] = 1.0
        with np.errstate(all='ignore'):
            for _ in range(DOUBLINGS):
                shared = np.linalg.solve(np.eye(n) + g @ h, np.column_stack([a, g]))
                before = h
                g = g + a @ shared[:, n:] @ a.T
                h = h + a.T @ h @ shared[:, :n]
                a = a @ shared[:, :n]
                h = 0.5 * (h + h.T)
                if np.allclose(h, before, rtol=1e-12, atol=0.0):
                    break
        if not np.isfinite(h).all() or not h[0, 0] > 0.0:
            raise ConfigurationError(
                f'parameters {", ".join(map(repr, DECIDING))}: expected values for which there is '
                'a Kalman filter in floating-point numbers, or noise_size = 0, got a noise of '
                f'{math.sqrt(self.variance):g} and an intensity of {self.intensity:g}'
            )
        return np.asarray(h * np.outer(unit, unit))


def stationary(chain: Matrix, intensity: float) -> Matrix:
    """Return the covariance of a chain whose last state is driven by white noise."""
    size = len(chain)
    drive = np.zeros((size, size))
    drive[-1, -1] = intensity
    eye = np.eye(size)
    whole = np.kron(chain, eye) + np.kron(eye, chain)
    return np.asarray(np.linalg.solve(whole, -drive.ravel()).reshape(size, size))


def transition(rates: Matrix, intensity: float, h: float) -> tuple[Matrix, Matrix]:
    """Return exp(A h) and Q, by the same series as the compiled recursion."""
    n = len(rates)
    fastest = float(np.abs(np.linalg.eigvals(rates)).max())
    count = max(math.ceil(min(h * fastest / STEP, MOST_STEPS)), 1)
    h /= count
    phi = term = np.eye(n)
    for order in range(1, n + 1):
        term = term @ rates * (h / order)
        phi = phi + term
    power = np.array([h ** (n - 1 - i) / math.factorial(n - 1 - i) for i in range(n)])
    places = np.arange(n)
    each = intensity * h * np.outer(power, power) / (2 * n - 1 - places[:, None] - places)
    whole, q = np.eye(n), np.zeros((n, n))
    for _ in range(count):
        q = phi @ q @ phi.T + each
        whole = phi @ whole
    return whole, q
