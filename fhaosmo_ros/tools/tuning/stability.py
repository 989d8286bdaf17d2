# SPDX-License-Identifier: Apache-2.0
"""How well the errors of the estimates are damped, for small and for large innovations."""

from fhaosmo_ros.core.observer.arrays import (
    CORRECTION_PERIOD,
    GAMMA_INITIAL,
    INVERSE_WIDTH,
    LAMBDA,
    part,
    PREDICTING,
    RATES,
    SCHEDULED,
    STEADY_VARIANCE,
)
from fhaosmo_ros.core.observer.levant import deadbeat_shares
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
    law = observer.law
    if not (law.flags[PREDICTING] and law.flags[SCHEDULED]):
        return 1.0
    n, h = observer.levels, law.scalars[CORRECTION_PERIOD]
    transition, shares = expm(law.chances[part(RATES, n)] * h), deadbeat_shares(n)
    level, grid = np.arange(n), np.linspace(0.0, 1.0, law.curves.shape[1])
    power = 2.0 * law.scalars[GAMMA_INITIAL] * (n - 1 - level) / n
    worst = 1.0
    for size in SIZES:
        a = max(size, SMALLEST) * np.sqrt(law.scalars[STEADY_VARIANCE])
        inputs = np.minimum(a * law.gains[INVERSE_WIDTH], 1.0)
        psi = np.array([np.interp(x, grid, c) for x, c in zip(inputs, law.curves, strict=True)])
        slopes = law.gains[LAMBDA] * a ** (power - 1.0) * psi
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
