# SPDX-License-Identifier: Apache-2.0
"""
Sets of gains that follow from the theory of the observer; a search begins with the best of them.

For |eps| well below its half-width w a fuzzy level is a second-order filter, z_tilde'' +
2 zeta omega z_tilde' + omega^2 z_tilde = omega^2 m', with omega^2 = alpha / w and a damping
2 zeta omega = lambda |eps|^gamma / w; above it, it is a super-twisting differentiator, which
converges if alpha exceeds the second derivative of m (A. Levant, Automatica 34(3), 1998,
doi:10.1016/S0005-1098(97)00209-4). So one bandwidth omega for the whole chain, one factor kappa
and one damping zeta give all gains:

    s_1 = noise,  s_i = noise sqrt(h omega^(2 i - 1))        the noise that is left in m_i
    w_i = kappa (s_i + L_i / omega^2)                        and the error by the lag
    alpha_i = omega^2 w_i
    lambda_i = 2 zeta omega w_i / (w_i / 3)^gamma            damped at a third of the half-width

with L_i the size of m_i'' in the recordings: z_3, .., d, d', d''. A small kappa is a sliding mode,
a large one a linear observer. The structure `levant` has one innovation and so one width,
w = kappa (noise + D / omega^n) with D the size of d, and N poles at omega:

    lambda_i = binomial(N, i) omega^i w / (w / 3)^(p_i),     p_i as in D 11

Some candidates are evaluated and the best one is taken: the best omega is a trade between noise
and lag, which depends on the family of d, and there is no formula for it.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from math import comb
from typing import Any

from fhaosmo_ros.core.observer.configuration import deadbeat_shares
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.start.sampled_model import SampledModel
import numpy as np
from numpy.typing import ArrayLike, NDArray

OMEGAS = tuple(float(w) for w in np.geomspace(2.0, 200.0, 9))
KAPPAS = (1.0, 5.0, 25.0)
ZETAS = (0.7, 1.5, 4.0)
SMALLEST = 1e-12
OPEN = 100.0
"""epsilon in units of the largest half-width: all levels run, except far from the estimate."""


def candidates(
    recordings: Sequence[Recording],
    levels: int,
    noise: float,
    structure: str = 'cascade',
    gammas: Sequence[float] = (0.5,),
) -> Iterator[dict[str, Any]]:
    """
    Yield lambda, alpha, fuzzy_widths, epsilon and gamma_initial by the rules above.

    Parameters
    ----------
    recordings : sequence of Recording
        With their truth.
    levels : int
        N.
    noise : float
        Standard deviation of y - z_1, the effect of jitter included.
    structure : str
        'cascade' or 'levant'.
    gammas : sequence of float
        Powers to try.

    """
    size = second_derivatives(recordings, levels)
    period = float(np.median(np.diff(recordings[0].t)))
    noise = max(noise, size[0] * period**2)
    level = np.arange(1, levels + 1)
    for omega, kappa, gamma in product(OMEGAS, KAPPAS, gammas):
        common = {'gamma_initial': gamma}
        if structure == 'levant':
            d = _rms(np.concatenate([r.d for r in recordings]))
            width = kappa * (noise + d / omega ** (levels - 1))
            poles = np.array([comb(levels, int(i)) for i in level]) * omega**level
            power = 2.0 * gamma * (levels - level) / levels
            yield common | {
                'lambda': _list(poles * width / (width / 3.0) ** power),
                'fuzzy_widths': [width] * levels,
            }
            continue
        left = noise * np.sqrt(period * omega ** (2.0 * level - 1.0))
        left[0] = noise
        widths = kappa * (left + size / omega**2)
        for zeta in ZETAS:
            yield common | {
                'lambda': _list(2.0 * zeta * omega * widths / (widths / 3.0) ** gamma),
                'alpha': _list(omega**2 * widths),
                'fuzzy_widths': _list(widths),
                'epsilon': OPEN * float(widths.max()),
            }


def kalman_like(
    model: SampledModel,
    bandwidth: float,
    widths: ArrayLike,
    curves: NDArray[np.float64],
    small: float,
    gamma: float,
) -> NDArray[np.float64]:
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
    k: NDArray[np.float64],
    h: float,
    widths: ArrayLike,
    curves: NDArray[np.float64],
    small: float,
    gamma: float,
) -> NDArray[np.float64]:
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


def second_derivatives(recordings: Sequence[Recording], levels: int) -> NDArray[np.float64]:
    """Return the RMS values L_1 .. L_N of z_3, .., z_n, d, d', .. over recordings."""
    chain = np.concatenate([np.column_stack([r.z, r.d]) for r in recordings])
    size = np.sqrt(np.mean(np.square(chain), axis=0))
    rates = [_rms(np.diff(r.d)) / (_rms(r.d) * np.median(np.diff(r.t))) for r in recordings]
    rate = float(np.median(rates))
    size = np.concatenate([size, size[-1] * rate ** np.arange(1, levels + 1)])
    return np.maximum(size[2 : 2 + levels], np.finfo(float).tiny)


def effective_noise(recordings: Sequence[Recording]) -> float:
    """Return the RMS of y - z_1: noise, quantum and, where z_1 is at the stamps, jitter."""
    return _rms(np.concatenate([r.y - r.z[:, 0] for r in recordings]))


def _list(values: NDArray[np.float64]) -> list[float]:
    return [float(v) for v in values]


def _rms(x: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
