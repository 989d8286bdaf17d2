# SPDX-License-Identifier: Apache-2.0
"""How well a method did on recordings, in numbers."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from fhaosmo_ros.core.simulation.metrics import high_passed, rms
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.objective import SMALLEST
import numpy as np
from numpy.typing import NDArray

JUDGED_FROM = 5.0
"""Seconds of each recording that are the transient."""
WINDOW = 0.25
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
    Scores of one method in one cell.

    Attributes
    ----------
    d : float
        RMS error of d over the RMS of d, after the transient.
    states : float
        RMS error of z_2 .. z_n, each over the RMS of the state itself, averaged.
    settling : float
        Seconds until the RMS error of d over `WINDOW` is first below half the RMS
        of d; infinite if it never is.
    chatter : float
        RMS of the error of d minus its moving average, over the RMS of d.

    """

    d: float
    states: float
    settling: float
    chatter: float


def objective(recording: Recording, estimates: Estimates) -> float:
    """Return the RMS error of d over the RMS of d; tuning minimises its geometric mean."""
    late = recording.t >= JUDGED_FROM
    d = recording.d[late]
    value = rms(estimates.d[late] - d) / rms(d)
    return value if np.isfinite(value) else float('inf')


def mean(errors: Iterable[float]) -> float:
    """Return the geometric mean: a tenth less counts the same on an easy case and a hard one."""
    return float(np.exp(np.mean(np.log(np.maximum(list(errors), SMALLEST)))))


def scores(recordings: Sequence[Recording], estimates: Sequence[Estimates]) -> Scores:
    """Return the scores over recordings: geometric means, and the median of settling times."""
    with np.errstate(over='ignore', invalid='ignore'):
        rows = [_one(r, e) for r, e in zip(recordings, estimates, strict=True)]
    d, states, settling, chatter = zip(*rows, strict=True)
    return Scores(mean(d), mean(states), float(np.median(settling)), mean(chatter))


def _one(recording: Recording, estimates: Estimates) -> tuple[float, float, float, float]:
    late = recording.t >= JUDGED_FROM
    error, size = estimates.d - recording.d, rms(recording.d[late])
    relative = [
        rms(estimates.z[late, i] - recording.z[late, i]) / rms(recording.z[late, i])
        for i in range(1, recording.z.shape[1])
    ]
    per_second = (len(recording.t) - 1) / (recording.t[-1] - recording.t[0])
    chatter = high_passed(error[late], max(3, round(CHATTER_WINDOW * per_second))) / size
    settling = _settling(recording, error, round(WINDOW * per_second))
    # A diverged estimate is infinitely wrong, not NaN.
    d, states, chatter = (
        x if np.isfinite(x) else float('inf')
        for x in (rms(error[late]) / size, float(np.mean(relative)), chatter)
    )
    return d, states, settling, chatter


def _settling(recording: Recording, error: Floats, window: int) -> float:
    total = np.concatenate([[0.0], np.cumsum(np.square(error))])
    moving = np.sqrt(np.maximum(total[window:] - total[:-window], 0.0) / window)
    inside = np.flatnonzero(moving <= SETTLED * rms(recording.d))
    return float(recording.t[inside[0]]) if len(inside) else float('inf')
