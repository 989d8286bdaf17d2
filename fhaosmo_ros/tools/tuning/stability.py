# SPDX-License-Identifier: Apache-2.0
"""How well the errors of the estimates are damped, for small and for large innovations."""

from fhaosmo_ros.core.observer.configuration import deadbeat_shares
from fhaosmo_ros.core.observer.kalman import Uncertainty
from fhaosmo_ros.core.observer.observer import Observer
import numpy as np
from scipy.linalg import expm

SIZES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0, 16.0)
"""
Of innovations, in the standard deviations of what is expected. With a d that is faster than
expected their spread grows, and so do the limits of D 21 and D 32.
"""
SMALLEST = 1e-3
"""Stands for an innovation of 0."""
DEADBEAT = 1e-12
"""Poles (z) that are smaller, or rates, count as 0."""


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
    rates = Uncertainty(c.model, c.parameters, c.state_sizes).rates
    transition, shares = expm(rates * h), deadbeat_shares(n)
    level, grid = np.arange(n), np.linspace(0.0, 1.0, c.curves.shape[1])
    power = 2.0 * c.gamma_initial * (n - 1 - level) / n
    expected = np.sqrt(c.schedule.steady[0, 0] + c.schedule.variance)
    worst = 1.0
    for size in SIZES:
        a = max(size, SMALLEST) * expected
        inputs = np.minimum(a / c.widths, 1.0)
        psi = np.array([np.interp(x, grid, y) for x, y in zip(inputs, c.curves, strict=True)])
        slopes = c.lambdas * a ** (power - 1.0) * psi
        wanted = np.array(
            [sum(shares[j, i] * h ** (j - i + 1) * slopes[j] for j in range(i, n)) for i in level]
        )
        k = wanted / (1.0 + wanted[0])
        errors = transition - np.outer(k, transition[0])
        if not np.isfinite(errors).all():
            return -1.0
        poles = np.linalg.eigvals(errors).astype(complex)
        rates = np.log(poles[np.abs(poles) > DEADBEAT])
        worst = min(worst, *(-rates.real / np.maximum(np.abs(rates), DEADBEAT)).tolist())
    return worst
