# SPDX-License-Identifier: Apache-2.0
"""Estimates of a sensor from its recorded y: noise, resolution, rate, jitter, losses."""

from math import comb
from typing import NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FEWEST = 200
"""An estimate needs so many samples."""
DIFFERENCES = range(1, 9)
"""Orders of the differences of y."""
NORMAL = 0.6745
"""Median of |x| of a standard normal x."""
ON_GRID = 0.02
"""Values count as quantised if they are this close to multiples of the quantum, relatively."""


class Sensor(NamedTuple):
    """
    Names as in `FAMILY_PARAMETERS`.

    Attributes
    ----------
    noise_std, quantisation : float
        In the unit of y; quantisation 0 for none that shows.
    sample_rate : float
        Hz.
    stamp_jitter : float
        s.
    dropout : float
        Share of the samples that are lost.
    dropout_length : float
        Mean number of them lost one after the other.

    """

    noise_std: float
    quantisation: float
    sample_rate: float
    stamp_jitter: float
    dropout: float
    dropout_length: float


def identify(t: Floats, y: Floats) -> Sensor:
    """
    Estimate a sensor from what it measured.

    The noise follows from differences of high order, in which a smooth signal vanishes. Medians
    make steps and outliers unimportant. Only white noise is found: noise that a filter in the
    sensor has smoothed looks like signal. Jitter of the periods and jitter of the stamps cannot be
    distinguished; it is taken as that of the stamps, which is the worse one.

    Parameters
    ----------
    t, y : (K,) arrays
        Stamps (s) and samples; those that do not increase or are not finite are left out.

    Raises
    ------
    ConfigurationError
        Too few samples.

    """
    good = np.isfinite(y) & np.isfinite(t)
    t, y = t[good], y[good]
    later = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]]) if len(t) else good[:0]
    t, y = t[later], y[later]
    if len(t) < FEWEST:
        raise ConfigurationError(
            f'bag: expected at least {FEWEST} samples of y with increasing stamps to estimate the '
            f'noise from, got {len(t)}'
        )
    h = np.diff(t)
    period = float(np.median(h))
    missing = np.maximum(np.round(h / period).astype(np.int64) - 1, 0)
    regular = missing == 0
    jitter = _spread(h[regular]) / float(np.sqrt(2.0))
    lost, gaps = int(missing.sum()), int((missing > 0).sum())
    quantum = _quantum(y)
    noise = _noise(y, regular)
    noise = float(np.sqrt(max(noise**2 - quantum**2 / 12.0, 0.0)))
    rate = (lost + len(h)) / float(t[-1] - t[0])
    return Sensor(
        noise, quantum, rate, jitter, lost / (lost + len(t)), lost / gaps if gaps else 1.0
    )


def _noise(y: Floats, regular: NDArray[np.bool_]) -> float:
    """Return the smallest estimate over the orders: low orders contain the signal as well."""
    found = []
    for order in DIFFERENCES:
        whole = np.lib.stride_tricks.sliding_window_view(regular, order).all(axis=1)
        differences = np.diff(y, order)[whole]
        if len(differences) >= FEWEST // 2:
            size = _spread(differences) or float(
                np.std(differences)
            )  # the median is 0 if quantised
            found.append(size / comb(2 * order, order) ** 0.5)
    return min(found) if found else 0.0


def _quantum(y: Floats) -> float:
    """Return the resolution of y, 0 if its values lie on no grid, or on a very fine one."""
    steps = np.abs(np.diff(y))
    steps = steps[steps > 0.0]
    if len(steps) < FEWEST // 10:
        return 0.0
    smallest = float(np.quantile(steps, 0.01))
    multiples = steps / smallest
    few = len(np.unique(np.round(multiples))) < len(steps) / 10
    near = np.abs(multiples - np.round(multiples)) <= ON_GRID * np.maximum(multiples, 1.0)
    if not few or near.mean() < 0.99:
        return 0.0
    whole = np.round(multiples)
    return float(np.sum(steps) / np.sum(whole))


def _spread(x: Floats) -> float:
    """Return the standard deviation without outliers, by the median of |x - median|."""
    return float(np.median(np.abs(x - np.median(x))) / NORMAL)
