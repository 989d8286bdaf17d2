# SPDX-License-Identifier: Apache-2.0
"""From what a recorded y shows to parameters of the estimator, and what these do with that y."""

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.online.counters import Counters
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, OBSERVER_PARAMETERS
from fhaosmo_ros.tools.tuning.identify import (
    Identified,
    ljung_box,
    NothingToFind,
    QUICKEST,
    SURE,
)
from fhaosmo_ros.tools.tuning.likelihood import CLIP
from fhaosmo_ros.tools.tuning.linear_gains import GAMMA, kalman_gains, rounded, SCHEME, WIDTH
from fhaosmo_ros.tools.tuning.objective import stamps_of
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SIZE_OF_USUAL = 0.9616
"""RMS of a standard normal number among the 99 % that are nearest to 0."""
UNSEEN = 0.97
"""Expected error of d over its size from which on an estimate tells nothing."""
NO_NOISE = 1e-7
"""Noise over the size of y below which y is a simulated one without noise."""
BEGIN = 0.1
"""Part of the bag in which the estimates may still be settling."""


class Gains(NamedTuple):
    """Parameters of the estimator, and what is to be expected if the model holds."""

    parameters: dict[str, Any]
    expected: Floats  # (n + 1,) standard deviations of the errors of z and d
    innovation: float  # standard deviation of the innovations
    share: float  # part of an innovation that is left after the correction, 1 - K_1


class Run(NamedTuple):
    """The estimator with these gains along the bag."""

    unknown_input: Floats  # (K,)
    size: float  # RMS innovation over the expected one, without the largest hundredth
    correlations: Floats  # (LAGS,) autocorrelations of the innovations
    probability: float  # of so large ones, were innovations white (Ljung and Box 1978)
    counters: Counters


def make_gains(found: Identified, given: Mapping[str, Any]) -> Gains:
    """
    Return the gains of the steady Kalman filter of what was found (D 17 to D 19).

    Raises
    ------
    NothingToFind
        There can be no gains, or the estimate of d would tell nothing.
    ConfigurationError
        There is no such filter in floating-point numbers.

    """
    _refuse(found)
    likelihood, design = found.likelihood, found.best.design
    order, period = likelihood.model.order, rounded(likelihood.period)
    noise, begin = rounded(found.best.noise), int(BEGIN * len(likelihood.samples.y))
    states = found.best.estimates[begin:, :order]
    sizes = np.maximum(np.sqrt(np.nanmean(np.square(states), axis=0)), noise)
    values = {
        **SCHEME,
        'correction_period': period,
        'noise_size': noise,
        'state_sizes': [rounded(x) for x in sizes],
        'unknown_input_size': rounded(found.size_of_input),
        'unknown_input_derivatives': design.derivatives,
        'unknown_input_decay': rounded(design.decay),
        'fuzzy_widths': [rounded(WIDTH * noise)],
        'gamma_initial': GAMMA,
        **given,
    }
    checked = OBSERVER_PARAMETERS.complete(OBSERVER_PARAMETERS.part_of(values))
    lambdas, k, p, variance = kalman_gains(checked, period)
    values['lambda'] = [rounded(x) for x in lambdas]
    errors = np.sqrt(np.maximum(np.diag(p) - k**2 * variance, 0.0))
    share = errors[order] / found.size_of_input
    if share > UNSEEN:
        raise NothingToFind(
            f'd: it changes too fast to be seen through this noise: the expected error is '
            f'{min(share, 1.0):.2f} of its size, and an estimate of 0 has 1.00. Does y drift or '
            'jump by itself, is its noise correlated from sample to sample (`gains: self_tuning` '
            f'follows that), or is the order ({order}) too high by one? Else a '
            'sensor with less noise, or a higher rate, is needed'
        )
    return Gains(values, errors[: order + 1], math.sqrt(variance), 1.0 - float(k[0]))


def _refuse(found: Identified) -> None:
    """Raise NothingToFind, which says why, where there can be no gains."""
    likelihood, design, y = found.likelihood, found.best.design, found.likelihood.samples.y
    period, noise = likelihood.period, found.best.noise
    top = 0.9 * QUICKEST / period
    silent = noise < NO_NOISE * float(np.std(y)) and not found.quantum
    if silent and not likelihood.fixed:
        raise NothingToFind(
            f'y: expected noise, got none that shows ({noise:.1e} in a y of '
            f'{np.std(y):.3g}), as in a simulation without noise: the less noise, the larger the '
            'gains, without limit. Say what the sensor will have: -p noise_size:=...'
        )
    if not likelihood.fixed and design.bandwidth > top:
        raise NothingToFind(
            f'y: the likeliest filter follows every sample ({design.bandwidth:.3g} rad/s at '
            f'{1.0 / period:.4g} Hz). Either y has no noise that shows, or it moves in a way that '
            'the model cannot: it jumps, or order or phi are wrong. Say what noise the sensor '
            'has (-p noise_size:=...), sample faster, or correct the model'
        )
    if found.silent < SURE:
        raise NothingToFind(
            f'd: expected a y that d moves, got one that the model explains with d = 0 (noise '
            f'{found.best.noise:.3g}). Record while the unknown input acts, and longer'
        )


def run(found: Identified, gains: Gains) -> Run:
    """Let the estimator run over the bag, as the node would, and judge its innovations."""
    samples = found.likelihood.samples
    t, begin = np.cumsum(samples.h), int(BEGIN * len(samples.y))
    estimator = OnlineEstimator(ESTIMATOR_PARAMETERS.complete(gains.parameters))
    u = samples.u if estimator.observer.uses_input else None
    trajectory = estimator.run(stamps_of(t), samples.y, u)
    r = trajectory.innovation[:, 0] / (gains.share * gains.innovation)
    r = r[np.isfinite(r) & samples.used & (np.arange(len(r)) >= begin)]
    usual = r[np.abs(r) <= np.quantile(np.abs(r), 0.99)]
    size = float(np.sqrt(np.mean(usual**2))) / SIZE_OF_USUAL
    whiteness = ljung_box(np.clip(r, -CLIP, CLIP))
    return Run(trajectory.unknown_input, size, *whiteness, estimator.counters)
