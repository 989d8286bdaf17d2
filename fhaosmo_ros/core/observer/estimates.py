# SPDX-License-Identifier: Apache-2.0
"""What the observer gives: after a sample, and of a run."""

from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.structure import Estimate as Estimate
import numpy as np
from numpy.typing import NDArray


class Tuning(NamedTuple):
    """
    What a self-tuning observer has found.

    Attributes
    ----------
    noise : float
        Standard deviation of the noise on y (unit of y), late stamps included.
    correlation : float
        Correlation of the noise of neighbouring samples; 0 for white noise.
    bandwidth : float
        How fast d is followed, in rad/s.
    derivatives : (4,) array
        Shares of the models of d with 0 to 3 derivatives.

    """

    noise: float
    correlation: float
    bandwidth: float
    derivatives: NDArray[np.float64]

    @classmethod
    def of(cls, found: NDArray[np.float64]) -> 'Tuning':
        """Return what the numbers mean that `TUNING` names."""
        noise, correlation, bandwidth = found[:3].tolist()
        return cls(noise, correlation, bandwidth, found[3:])


TUNING = ['noise', 'correlation', 'bandwidth', *(f'derivatives{k}' for k in range(4))]
"""Names of these numbers in the columns of `Trajectory.tuning`."""


class Trajectory(NamedTuple):
    """
    Estimates of a run; row k belongs to ``t[k]``. Attributes as in `Estimate`.

    Attributes
    ----------
    t : (K,) array
        Times as given.
    z : (K, n) array
    unknown_input, gamma : (K,) arrays
    innovation : (K, N) array
    status, open_levels : (K,) integer arrays
    z_hat, z_tilde : (K, N) arrays
        Filtered and internal states; z_tilde[:, i] belongs to z_{i+2}.
    standard_deviation : (K, n + 1) array
        Of the errors of z and, in the last column, of the unknown input, as a self-tuning observer
        expects them; (K, 0) with fixed gains.
    model : (K, 4) array
        The likeliest model of d (D 26) of a self-tuning observer, which a smoother goes by: the
        variance of the noise, if it were white; q; kappa (1/s); the number k of derivatives, or
        k - 4 where d has jumped. 0 before it knows the noise; (K, 0) with fixed gains.
    tuning : (K, 7) array
        What a self-tuning observer has found, with columns as `TUNING` names them; NaN before it
        knows the noise; (K, 0) with fixed gains.

    """

    t: NDArray[Any]
    z: NDArray[np.float64]
    unknown_input: NDArray[np.float64]
    gamma: NDArray[np.float64]
    innovation: NDArray[np.float64]
    status: NDArray[np.int64]
    open_levels: NDArray[np.int64]
    z_hat: NDArray[np.float64]
    z_tilde: NDArray[np.float64]
    standard_deviation: NDArray[np.float64]
    model: NDArray[np.float64]
    tuning: NDArray[np.float64]

    def __repr__(self) -> str:
        if not len(self.t):
            return 'Trajectory(no samples)'
        z = ', '.join(f'z{i + 1}={value:.4g}' for i, value in enumerate(self.z[-1]))
        return (
            f'Trajectory({len(self.t)} samples, t={self.t[0]} .. {self.t[-1]}, the last one: '
            f'{z}, unknown_input={self.unknown_input[-1]:.4g})'
        )

    def rows(self, index: Any) -> 'Trajectory':
        """Return those of its rows that an index of NumPy picks."""
        return Trajectory._make(column[index] for column in self)
