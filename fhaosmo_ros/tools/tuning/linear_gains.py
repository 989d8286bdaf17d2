# SPDX-License-Identifier: Apache-2.0
"""lambda with which the observer is a Kalman filter (D 17 to D 19)."""

from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import deadbeat_shares
from fhaosmo_ros.core.observer.fuzzy import curves
from fhaosmo_ros.core.observer.kalman import Uncertainty
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Floats = NDArray[np.float64]
SCHEME: Mapping[str, Any] = {
    'structure': 'levant',
    'scheme': 'predict_correct',
    'variant': 'fuzzy_adaptive',
    'gamma_rate': 0.0,
    'gamma_min': 1e-4,
}
"""The observer that these gains are for."""
WIDTH = 16.0
"""
Half-width over the noise: nearly linear for the noise itself, and outliers count as a few standard
deviations of it.
"""
GAMMA = 3e-3  # power at which the injections are nearly linear in the innovation
SMALLEST = 1e-12  # stands for 1 - K_1 of a deadbeat observer
LEAST = 1e-30  # gain that stands for one that is not positive


def chosen_otherwise(estimator: Mapping[str, Any]) -> list[str]:
    """Return the parameters, as set by the user, that ask for something else than `SCHEME`."""
    wanted = {**SCHEME, 'unknown_input': True}
    differ = ('structure', 'scheme', 'unknown_input')
    return [name for name in differ if estimator.get(name, wanted[name]) != wanted[name]]


def kalman_gains(p: Mapping[str, Any], period: float) -> tuple[list[float], Floats]:
    """
    Return lambda with which predict_correct is the Kalman filter that parameters ask for (D 19).

    `p` are all of the observer's: its model, noise_size, the model of d, the first of fuzzy_widths
    for all levels, and gamma_initial; `period` is that of sampling (s). Behind the N rounded
    lambda are the standard deviations of the errors of the filter's estimates, once they are
    steady. Raises ConfigurationError where there is no such filter in floating-point numbers, or
    psi is 0 at the size of the noise.
    """
    model = TriangularModel.of(p)
    uncertainty = Uncertainty(model, p, np.zeros(model.order))
    predicted = uncertainty.steady(period)
    variance = predicted[0, 0] + uncertainty.variance
    gain = predicted[0] / variance
    n, level = len(gain), np.arange(len(gain))
    # Every injection is a function of eps = (1 - K_1) b, the innovation after the correction.
    # Corrections are beta_ji h^(j - i + 1) times the injections (D 18).
    exponents = level[None, :] - level[:, None] + 1.0
    corrections = np.triu(deadbeat_shares(n).T * period**exponents)
    injections = solve_triangular(corrections, gain / max(1.0 - gain[0], SMALLEST))
    width = p['fuzzy_widths'][0]
    small = max(p['noise_size'], 1e-3 * width)  # an innovation that noise alone causes
    power = 2.0 * p['gamma_initial'] * level[::-1] / n  # of the innovation (D 11)
    curve = curves(p, n)
    grid = np.linspace(0.0, 1.0, curve.shape[1])
    psi = np.array([np.interp(small / width, grid, row) for row in curve])
    if not psi.all():
        raise ConfigurationError(f'Kalman gain: expected psi > 0 at {small:g}, got {psi}')
    lambdas = injections * small ** (1.0 - power) / psi
    lambdas = lambdas.clip(LEAST, OBSERVER_PARAMETERS['lambda'].upper)
    errors = np.sqrt(np.maximum(np.diag(predicted) - gain**2 * variance, 0.0))
    return [*map(rounded, lambdas)], errors


def rounded(value: float) -> float:
    """Return a number as it is written to files, with four digits."""
    return float(f'{value:.4g}')
