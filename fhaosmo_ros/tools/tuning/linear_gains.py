# SPDX-License-Identifier: Apache-2.0
"""lambda of a Kalman filter, and the linear observer that given lambda come to (D 18, D 19)."""

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import deadbeat_shares
from fhaosmo_ros.core.observer.fuzzy import curves
from fhaosmo_ros.core.observer.kalman import Uncertainty
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_triangular

Floats = NDArray[np.float64]
SMALLEST = 1e-12
"""Stands for 1 - K_1 of a deadbeat observer."""
LEAST = 1e-30
"""Gain that stands for one that is not positive."""
SIZES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0, 16.0)
"""
Of innovations, in the standard deviations of what is expected. With a d that is faster than
expected their spread grows, and so do the limits of D 21 and D 32.
"""
STILL = 1e-3
"""Stands for an innovation of 0."""
DEADBEAT = 1e-12
"""Poles (z) that are smaller, or rates, count as 0."""


class KalmanGains(NamedTuple):
    """
    The steady-state Kalman filter of a model, and the observer that equals it.

    Attributes
    ----------
    lambdas : (N,) array
        Of the observer.
    gain : (N,) array
        K of a filter that predicts and then corrects.
    predicted : (N, N) array
        Covariance of the errors of its predictions.
    variance : float
        Of its innovations.

    """

    lambdas: Floats
    gain: Floats
    predicted: Floats
    variance: float


def kalman_gains(model: TriangularModel, p: Mapping[str, Any], period: float) -> KalmanGains:
    """
    Return lambda with which predict_correct is the Kalman filter that parameters ask for (D 19).

    Parameters
    ----------
    model : TriangularModel
    p : mapping
        Of the observer, complete: noise_size, the model of d, the first of fuzzy_widths for all
        levels, and gamma_initial.
    period : float
        Sampling period (s).

    Raises
    ------
    ConfigurationError
        There is no such filter in floating-point numbers, or psi is 0 at the size of the noise.

    """
    uncertainty = Uncertainty(model, p, np.zeros(model.order))
    predicted = uncertainty.steady(period)
    variance = predicted[0, 0] + uncertainty.variance
    gain = predicted[0] / variance
    width = p['fuzzy_widths'][0]
    small = max(p['noise_size'], 1e-3 * width)
    lambdas = with_gain(gain, period, width, curves(p, len(gain)), small, p['gamma_initial'])
    lambdas = lambdas.clip(LEAST, OBSERVER_PARAMETERS['lambda'].upper)
    return KalmanGains(lambdas, gain, predicted, variance)


def matern(rate: float, derivatives: int) -> float:
    """Return the intensity of the white noise behind a Matern d of the RMS 1 (D 17)."""
    k = derivatives
    return (2.0 * rate) ** (2 * k + 1) * math.factorial(k) ** 2 / math.factorial(2 * k)


def with_gain(
    k: Floats, h: float, widths: Any, curves: Floats, small: float, gamma: float
) -> Floats:
    """
    Return lambda_1 .. lambda_N with which predict_correct has the gains K_1 .. K_N (D 19).

    Parameters
    ----------
    k : (N,) array
        Gains of a linear observer that predicts and then corrects.
    h : float
        Sampling period (s).
    widths : float or (N,) array
        Half-widths, unit of y.
    curves : (N, K) array
        psi of each level; see `fuzzy.curves`.
    small : float
        Size of the innovations that noise alone causes, unit of y.
    gamma : float

    Raises
    ------
    ConfigurationError
        psi is 0 there.

    """
    # Every injection is a function of eps = (1 - k_1) b, the innovation after the correction.
    injections = solve_triangular(_corrections(len(k), h), k / max(1.0 - k[0], SMALLEST))
    psi = _membership(curves, np.broadcast_to(small / np.asarray(widths), len(k)))
    if not psi.all():
        raise ConfigurationError(f'Kalman gain: expected psi > 0 at {small:g}, got {psi}')
    return np.asarray(injections * small ** (1.0 - _power(len(k), gamma)) / psi)


def least_damping(observer: Observer) -> float:
    """
    Return the smallest damping ratio of the errors' dynamics, linearised at rest (D 18).

    For each of `SIZES` the corrections count as linear: K_i is what they are over the innovation.
    Below 0 the errors grow by themselves. 1 without `noise_size` or with another scheme, where
    other rules hold.
    """
    c = observer.configuration
    if not c.predicting or c.schedule is None:
        return 1.0
    n, h = c.levels, c.parameters['correction_period']
    transition = expm(Uncertainty(c.model, c.parameters, c.state_sizes).rates * h)
    expected = np.sqrt(c.schedule.steady[0, 0] + c.schedule.variance)
    worst = 1.0
    for size in SIZES:
        a = max(size, STILL) * expected
        psi = _membership(c.curves, np.minimum(a / c.widths, 1.0))
        wanted = _corrections(n, h) @ (c.lambdas * a ** (_power(n, c.gamma_initial) - 1.0) * psi)
        errors = transition - np.outer(wanted / (1.0 + wanted[0]), transition[0])
        if not np.isfinite(errors).all():
            return -1.0
        poles = np.linalg.eigvals(errors).astype(complex)
        rates = np.log(poles[np.abs(poles) > DEADBEAT])
        worst = min(worst, *(-rates.real / np.maximum(np.abs(rates), DEADBEAT)).tolist())
    return worst


def _corrections(n: int, h: float) -> Floats:
    """Return the matrix from injections to corrections, beta_ji h^(j - i + 1) (D 18)."""
    level = np.arange(n)
    return np.triu(deadbeat_shares(n).T * h ** (level[None, :] - level[:, None] + 1.0))


def _power(n: int, gamma: float) -> Floats:
    """Return the powers of the innovation in the injections (D 11)."""
    return 2.0 * gamma * np.arange(n - 1.0, -1.0, -1.0) / n


def _membership(curves: Floats, inputs: Floats) -> Floats:
    """Return psi of each level at its input."""
    grid = np.linspace(0.0, 1.0, curves.shape[1])
    return np.array([np.interp(x, grid, curve) for x, curve in zip(inputs, curves, strict=True)])
