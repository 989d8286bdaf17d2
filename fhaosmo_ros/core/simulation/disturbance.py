# SPDX-License-Identifier: Apache-2.0
"""Unknown inputs d(t) that the simulated plant can be given."""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
import numpy as np

KINDS = ('none', 'sine', 'step', 'square', 'chirp')
NONE, SINE, STEP, SQUARE, CHIRP = range(5)
SAMPLED = 5
"""Any d(t) as a table: c is its spacing and then its values from t = 0 on (not a plant's kind)."""
NAMES = ('amplitude', 'omega', 'phase', 'offset', 'start', 'omega_end', 'sweep_time')
AMPLITUDE, OMEGA, PHASE, OFFSET, START, OMEGA_END, SWEEP_TIME = range(7)


@compiled()
def disturbance(kind: int, c: Floats, t: float) -> float:
    """
    Return d(t).

    Parameters
    ----------
    kind : int
        Index into `KINDS`, or `SAMPLED`.
    c : (7,) array
        Values in the order of `NAMES` (rad/s, rad, s); the table of `SAMPLED`, which is
        interpolated linearly and holds its last value.
    t : float
        Time since the plant's start, in seconds.

    """
    if kind == NONE:
        return 0.0
    if kind == SAMPLED:
        position = t / c[0]
        j = 1 + min(int(position), c.shape[0] - 3)
        part = min(position - (j - 1), 1.0)
        return float(c[j] + part * (c[j + 1] - c[j]))
    if kind == STEP:
        return float(c[OFFSET] + (c[AMPLITUDE] if t >= c[START] else 0.0))
    angle = c[OMEGA] * t
    if kind == CHIRP:
        swept = min(t, c[SWEEP_TIME])
        rate = (c[OMEGA_END] - c[OMEGA]) / c[SWEEP_TIME]
        angle = c[OMEGA] * swept + 0.5 * rate * swept * swept + c[OMEGA_END] * (t - swept)
    wave = math.sin(angle + c[PHASE])
    if kind == SQUARE:
        wave = 1.0 if wave >= 0.0 else -1.0
    return float(c[OFFSET] + c[AMPLITUDE] * wave)


@compiled()
def disturbances(kind: int, c: Floats, t: Floats) -> Floats:
    """Return d at many times, shape (K,)."""
    d = np.empty(t.shape[0])
    for k in range(t.shape[0]):
        d[k] = disturbance(kind, c, t[k])
    return d
