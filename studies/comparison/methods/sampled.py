# SPDX-License-Identifier: Apache-2.0
"""
The sampled linear model of the peers, and its steady-state Kalman gains.

All gains are for a filter that predicts to t_k and then corrects with y_k itself. States are
scaled by powers of the period, because the Riccati equation is badly conditioned otherwise. The
covariance of the process noise over a period is Van Loan's integral by matrix exponentials: C. F.
Van Loan, IEEE Transactions on Automatic Control 23(3), 1978, doi:10.1109/TAC.1978.1101743.
"""

from collections.abc import Sequence

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

Matrix = NDArray[np.float64]
LONGEST_STEP = 1.0
"""Upper limit of `resolution` in seconds, for a model without dynamics of its own."""


class SampledModel:
    """
    The model, linearised at rest and extended by a chain of integrators that makes d.

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

    """

    def __init__(
        self,
        model: TriangularModel,
        period: float,
        chain: int = 1,
        integrators_only: bool = False,
        decay: float = 0.0,
    ) -> None:
        n, self.size, self.period = model.order, model.order + chain, period
        self.scale = period ** np.arange(self.size)
        """Powers of the period: scaled states are x_i * period^(i - 1)."""
        self._rates = np.eye(self.size, k=1)
        self._rates[range(n, self.size), range(n, self.size)] = -decay
        jacobian = model.jacobian(np.zeros(n))
        fastest = np.max(np.abs(np.linalg.eigvals(jacobian + np.eye(n, k=1))))
        self.resolution = min(0.03 / max(float(fastest), 1e-9), LONGEST_STEP)
        """
        Runge-Kutta steps (s) up to this one have a negligible error. For a linear model steps of
        0.1 / fastest rate would do; a nonlinearity that is crossed within a few steps, such as dry
        friction, needs shorter ones.
        """
        if not integrators_only:
            self._rates[:n, :n] += jacobian
        self.a = self._scaled(expm(self._rates * period))
        """(N, N): transition over a period, in scaled states."""
        self._c = np.eye(self.size)[:1]

    def _scaled(self, matrix: Matrix) -> Matrix:
        return matrix * self.scale[:, None] / self.scale[None, :]

    def kalman(self, intensities: Sequence[float]) -> Matrix:
        """
        Return the steady-state Kalman gain for noise of variance 1 on y.

        `intensities` are those of the white noises that drive the last states of the chain, the
        last state's first.
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
        n, rates = self.size, self._scaled(self._rates) * self.period
        spectrum = np.zeros(n)
        spectrum[n - len(intensities) :] = intensities[::-1]
        spectrum = spectrum * self.scale**2 * self.period
        largest = float(spectrum.max()) or 1.0
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:], block[n:, n:] = -rates, np.diag(spectrum / largest), rates.T
        exponential = expm(block)
        covariance = largest * exponential[n:, n:].T @ exponential[:n, n:]
        return 0.5 * (covariance + covariance.T)
