# SPDX-License-Identifier: Apache-2.0
"""Estimates of a sensor from its recorded y: resolution, rate, jitter, losses."""

from typing import NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

Floats = NDArray[np.float64]

FEWEST = 200
"""An estimate needs so many samples."""
ON_GRID = 0.02
"""Values count as quantised if they are this close to multiples of the quantum, relatively."""


class Sensor(NamedTuple):
    """
    Names as in `FAMILY_PARAMETERS`.

    Attributes
    ----------
    quantisation : float
        In the unit of y; 0 for none that shows.
    sample_rate : float
        Hz.
    stamp_jitter : float
        s.
    dropout : float
        Share of the samples that are lost.

    """

    quantisation: float
    sample_rate: float
    stamp_jitter: float
    dropout: float


def identify(t: Floats, y: Floats) -> Sensor:
    """
    Estimate a sensor from what it measured.

    Jitter of the periods and jitter of the stamps cannot be distinguished; it is taken as that of
    the stamps, which is the worse one.

    Parameters
    ----------
    t, y : (K,) arrays
        Stamps (s) and samples; those that do not increase or are not finite are left out.

    Raises
    ------
    ConfigurationError
        Too few samples.

    """
    keep = usable(t, y)
    t, y = t[keep], y[keep]
    if len(t) < FEWEST:
        raise ConfigurationError(
            f'bag: expected at least {FEWEST} samples of y with increasing stamps to estimate the '
            f'sensor from, got {len(t)}'
        )
    h = np.diff(t)
    period = float(np.median(h))
    missing = np.maximum(np.round(h / period).astype(np.int64) - 1, 0)
    jitter = float(median_abs_deviation(h[missing == 0], scale='normal') / np.sqrt(2.0))
    lost = int(missing.sum())
    rate = (lost + len(h)) / float(t[-1] - t[0])
    return Sensor(_quantum(y), rate, jitter, lost / (lost + len(t)))


def usable(t: Floats, *values: Floats) -> NDArray[np.bool_]:
    """Return which samples are finite and later than all before them."""
    finite = np.isfinite(np.column_stack([t, *values])).all(axis=1)
    latest = np.maximum.accumulate(np.where(finite, t, -np.inf))
    return finite & (t > np.concatenate([[-np.inf], latest[:-1]])[: len(t)])


def _quantum(y: Floats) -> float:
    """Return the resolution of y, 0 if its values lie on no grid, or on a very fine one."""
    steps = np.abs(np.diff(y))
    steps = steps[steps > 0.0]
    if len(steps) < FEWEST // 10:
        return 0.0
    multiples = steps / np.quantile(steps, 0.01)
    whole = np.round(multiples)
    few = len(np.unique(whole)) < len(steps) / 10
    near = np.abs(multiples - whole) <= ON_GRID * np.maximum(multiples, 1.0)
    return float(np.sum(steps) / np.sum(whole)) if few and near.mean() >= 0.99 else 0.0
