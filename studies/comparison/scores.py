# SPDX-License-Identifier: Apache-2.0
"""How well an unknown input was estimated, in numbers."""

from collections.abc import Iterable
from typing import NamedTuple

from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.objective import SMALLEST
import numpy as np
from numpy.typing import NDArray

JUDGED_FROM = 5.0
"""Seconds of each recording that are the transient."""

Floats = NDArray[np.float64]


class Estimates(NamedTuple):
    """Estimated states (K, n) and unknown input (K,), one row a sample."""

    z: Floats
    d: Floats


def objective(recording: Recording, estimates: Estimates) -> float:
    """Return the RMS error of d over the RMS of d; tuning minimises its geometric mean."""
    late = recording.t >= JUDGED_FROM
    d = recording.d[late]
    with np.errstate(over='ignore', invalid='ignore'):
        value = rms(estimates.d[late] - d) / rms(d)
    return value if np.isfinite(value) else float('inf')


def mean(errors: Iterable[float]) -> float:
    """Return the geometric mean: a tenth less counts the same on an easy case and a hard one."""
    return float(np.exp(np.mean(np.log(np.maximum(list(errors), SMALLEST)))))
