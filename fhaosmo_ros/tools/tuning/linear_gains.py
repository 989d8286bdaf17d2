# SPDX-License-Identifier: Apache-2.0
"""
Gains of the steady-state Kalman filter, and lambda with which the observer has them (D 19).

All gains are for a filter that predicts to t_k and then corrects with y_k itself. States are
scaled by powers of the period, because the Riccati equation is badly conditioned otherwise. The
covariance of the process noise over a period is Van Loan's integral by matrix exponentials: C. F.
Van Loan, IEEE Transactions on Automatic Control 23(3), 1978, doi:10.1109/TAC.1978.1101743.
"""

from collections.abc import Sequence

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import deadbeat_shares
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm, solve_discrete_are

Matrix = NDArray[np.float64]
SMALLEST = 1e-12
"""Stands for 1 - K_1 of a deadbeat observer."""
LONGEST_STEP = 1.0
"""Upper limit of `resolution` in seconds, for a model without dynamics of its own."""


class SampledModel:
    """
    The model, linearised at rest and extended by a chain of `chain` integrators that makes d.

    Parameters
    ----------
    model : TriangularModel
    period : float
        Sampling period in seconds.
    chain : int
        Integrators that model d: with 1 the white noise drives d itself, with 2 its derivative.
    integrators_only : bool
        Take Phi = 0, as for the gains of an extended state observer.
    decay : float
        Rate (1/s) at which all states of the chain decay, so that d is a Matern process.

    Attributes
    ----------
    scale : (N,) array
        Powers of the period, 0 to N - 1.
    a : (N, N) array
        Transition over a period, in scaled states x_i * period^(i - 1).
    resolution : float
        Runge-Kutta steps (s) up to this one have a negligible error. For a linear model steps of
        0.1 / fastest rate would do; a nonlinearity that is crossed within a few steps, such as
        dry friction, needs shorter ones.

    """

    def __init__(
        self,
        model: TriangularModel,
        period: float,
        chain: int = 1,
        integrators_only: bool = False,
        decay: float = 0.0,
    ) -> None:
        self.size = model.order + chain
        self.period = period
        self.scale = period ** np.arange(self.size)
        self._rates = np.eye(self.size, k=1)
        self._rates[range(model.order, self.size), range(model.order, self.size)] = -decay
        jacobian = model.jacobian(np.zeros(model.order))
        fastest = np.max(np.abs(np.linalg.eigvals(jacobian + np.eye(model.order, k=1))))
        self.resolution = min(0.03 / max(float(fastest), 1e-9), LONGEST_STEP)
        if not integrators_only:
            self._rates[: model.order, : model.order] += jacobian
        self.a = self._scaled(expm(self._rates * period))
        self._c = np.eye(self.size)[:1]

    def _scaled(self, matrix: Matrix) -> Matrix:
        return matrix * self.scale[:, None] / self.scale[None, :]

    def kalman(self, intensities: Sequence[float]) -> Matrix:
        """
        Return the steady-state Kalman gain for noise of variance 1 on y.

        Parameters
        ----------
        intensities : sequence of float
            Of the continuous white noises that drive the last states of the chain; the first one
            is that of the last state.

        """
        noise = self.process_noise(intensities)
        try:
            with np.errstate(invalid='ignore'):  # the result is checked below
                p = solve_discrete_are(self.a.T, self._c.T, noise, np.eye(1))
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ConfigurationError(f'Kalman gain: no solution ({error})') from None
        gain = p[:, 0] / (p[0, 0] + 1.0) / self.scale
        if not np.isfinite(gain).all():
            raise ConfigurationError(f'Kalman gain: expected finite numbers, got {gain}')
        return gain

    def process_noise(self, intensities: Sequence[float]) -> Matrix:
        """Return what noise as in `kalman` adds to the scaled covariance (Van Loan 1978)."""
        spectrum = np.zeros(self.size)
        for i, value in enumerate(intensities):
            spectrum[self.size - 1 - i] = value
        n, rates = self.size, self._scaled(self._rates) * self.period
        spectrum = spectrum * self.scale**2 * self.period
        largest = float(spectrum.max()) or 1.0
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:], block[n:, n:] = -rates, np.diag(spectrum / largest), rates.T
        exponential = expm(block)
        covariance = largest * exponential[n:, n:].T @ exponential[:n, n:]
        return 0.5 * (covariance + covariance.T)


def kalman_like(
    model: SampledModel,
    bandwidth: float,
    widths: ArrayLike,
    curves: Matrix,
    small: float,
    gamma: float,
) -> Matrix:
    """
    Return lambda_1 .. lambda_N with which predict_correct is a Kalman filter (D 19).

    For innovations of the size `small` the corrections are those of the steady-state Kalman filter
    of the model, linearised at rest, whose last level is driven by white noise. For a chain of N
    integrators and (intensity / density of the noise on y) = bandwidth^(2 N) its poles are
    Butterworth's, at the distance `bandwidth`.

    Parameters
    ----------
    model : SampledModel
        With the observer's model of d.
    bandwidth : float
        rad/s.
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
        The Riccati equation has no solution in floating-point numbers, or psi is 0 there.

    """
    n, h = model.size, model.period
    k = model.kalman([h * bandwidth ** (2 * n)])
    return with_gain(k, h, widths, curves, small, gamma)


def with_gain(
    k: Matrix,
    h: float,
    widths: ArrayLike,
    curves: Matrix,
    small: float,
    gamma: float,
) -> Matrix:
    """
    Return lambda_1 .. lambda_N with which predict_correct has the gains K_1 .. K_N (D 19).

    Parameters
    ----------
    k : (N,) array
        Gains of a linear observer that predicts and then corrects.
    h : float
        Sampling period (s).
    widths, curves, small, gamma
        As for `kalman_like`.

    Raises
    ------
    ConfigurationError
        psi is 0 there.

    """
    n = len(k)
    # Every injection is a function of eps = (1 - k_1) b, the innovation after the correction.
    wanted = k / max(1.0 - k[0], SMALLEST)
    injections = np.zeros(n)
    share = deadbeat_shares(n)
    for i in reversed(range(n)):  # wanted_i = sum_j beta_ji h^(j-i+1) v_j  (D 19)
        behind = sum(share[j, i] * h ** (j - i + 1) * injections[j] for j in range(i + 1, n))
        injections[i] = (wanted[i] - behind) / h
    level = np.arange(1, n + 1)
    power = 2.0 * gamma * (n - level) / n  # D 11
    grid = np.linspace(0.0, 1.0, curves.shape[1])
    psi = np.array(
        [
            np.interp(small / width, grid, curve)
            for width, curve in zip(np.broadcast_to(widths, n), curves, strict=True)
        ]
    )
    if not psi.all():
        raise ConfigurationError(f'Kalman gain: expected psi > 0 at {small:g}, got {psi}')
    return np.asarray(injections * small ** (1.0 - power) / psi)
