# SPDX-License-Identifier: Apache-2.0
"""How well a method did on recordings, in numbers."""

from collections.abc import Sequence
from typing import NamedTuple

from fhaosmo_ros.core.family import Recording
from fhaosmo_ros.core.metrics import high_passed, rms
import numpy as np
from numpy.typing import NDArray

JUDGED_FROM = 5.0
"""Seconds of each recording that are the transient."""
WINDOW = 0.5
"""Seconds over which the error of d is averaged for the settling time."""
SETTLED = 0.5
"""Fraction of d's RMS below which that average has settled."""
CHATTER_WINDOW = 0.1
"""Seconds of the moving average that chatter is measured against."""

Floats = NDArray[np.float64]


class Estimates(NamedTuple):
    """Estimated states (K, n) and unknown input (K,), one row a sample."""

    z: Floats
    d: Floats


class Scores(NamedTuple):
    """
    Scores of one method in one cell, averaged over the recordings.

    Attributes
    ----------
    d : float
        RMS error of d, in d's unit.
    states : float
        RMS error of z_2 .. z_n, each over the RMS of the state itself, averaged.
    settling : float
        Seconds until the RMS error of d over `WINDOW` stays below half the RMS of d; infinite if
        it never does.
    chatter : float
        RMS of what a moving average leaves of the error of d, in d's unit.

    """

    d: float
    states: float
    settling: float
    chatter: float


def objective(recording: Recording, estimates: Estimates) -> float:
    """Return what the tuning minimises: the RMS error of d over the RMS of d."""
    late = recording.t >= JUDGED_FROM
    d = recording.d[late]
    value = rms(estimates.d[late] - d) / rms(d)
    return value if np.isfinite(value) else float('inf')


def scores(recordings: Sequence[Recording], estimates: Sequence[Estimates]) -> Scores:
    """Return the averages over recordings: of squares for RMS errors, the median of settling."""
    rows = np.array([_one(r, e) for r, e in zip(recordings, estimates, strict=True)])
    d, states, chatter = np.sqrt(np.mean(np.square(rows[:, [0, 1, 3]]), axis=0))
    return Scores(float(d), float(states), float(np.median(rows[:, 2])), float(chatter))


def _one(recording: Recording, estimates: Estimates) -> tuple[float, float, float, float]:
    late = recording.t >= JUDGED_FROM
    error = estimates.d - recording.d
    relative = [
        rms(estimates.z[late, i] - recording.z[late, i]) / rms(recording.z[late, i])
        for i in range(1, recording.z.shape[1])
    ]
    per_second = (len(recording.t) - 1) / (recording.t[-1] - recording.t[0])
    chatter = high_passed(error[late], max(3, round(CHATTER_WINDOW * per_second)))
    # A diverged estimate is infinitely wrong, not NaN.
    d, states = rms(error[late]), float(np.sqrt(np.mean(np.square(relative))))
    finite = [x if np.isfinite(x) else float('inf') for x in (d, states, chatter)]
    return finite[0], finite[1], settling(recording, error, round(WINDOW * per_second)), finite[2]


def settling(recording: Recording, error: Floats, window: int) -> float:
    """Return the time from which on the averaged error is below the threshold; see `Scores`."""
    total = np.concatenate([[0.0], np.cumsum(np.square(error))])
    with np.errstate(invalid='ignore'):
        moving = np.sqrt(np.maximum(total[window:] - total[:-window], 0.0) / window)
    outside = np.flatnonzero(~(moving <= SETTLED * rms(recording.d)))
    if not len(outside):
        return 0.0
    last = outside[-1] + window
    return float(recording.t[last]) if last < len(recording.t) else float('inf')
