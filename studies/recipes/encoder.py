# SPDX-License-Identifier: Apache-2.0
"""Velocity and acceleration of a joint from its encoder: simulations with 4096 counts a turn."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from fhaosmo_ros.core import Family
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, savgol_coeffs
from studies.harness import SELF_TUNING
from studies.recipes import peers
from studies.recipes.judging import (
    FIXED,
    fixed_gains,
    Fold,
    Method,
    model,
    OURS,
    Recorded,
    run,
)

Floats = NDArray[np.float64]
DATA = None
QUANTITY, SCALE = 'acceleration [rad/s²]', 1.0
SHOWN, SHOWN_FOLD, BAND = (2.0, 4.0), 0, False
ACCELERATION, VELOCITY = 'acceleration', 'velocity'
KINDS = ('smooth', 'steps')
"""Of acceleration, as `disturbances` below has them in turn."""
JOINT = {
    'order': 2, 'phi': ['0', '0'], 'duration': 8.0, 'sample_rate': 1000.0, 'initial_state': 0.0,
    'quantisation': 2 * np.pi / 4096, 'noise_std': 0.0, 'rms_of_d': 20.0, 'band_of_d': [2.0, 15.0],
    'disturbances': ['sines', 'steps'], 'step_interval': 0.5,
}  # fmt: skip
SETTLED, RECORDINGS = 1.0, 4
"""s; recordings for tuning, and as many for judging."""
BANDWIDTHS = np.geomspace(10.0, 500.0, 25).tolist()
WINDOWS = [float(window) for window in range(11, 202, 10)]


def difference(_: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return differences behind a first-order low pass; of the velocity for the acceleration."""
    order = 1 if r.quantity == VELOCITY else 2
    return peers.low_passed(r.y, bandwidth, r.period, order, order)


def savitzky_golay(degree: int, _: Mapping[str, Any], r: Recorded, window: float) -> Floats:
    """Return the derivative, at the newest sample, of a polynomial through the last ones."""
    count, derivative = round(window), 1 if r.quantity == VELOCITY else 2
    weights = savgol_coeffs(count, degree, derivative, r.period, pos=count - 1)
    found: Floats = lfilter(weights, [1.0], r.y)
    return found


def this_observer(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return z2 or d of the observer with gains of a bandwidth; 0: self-tuning."""
    gains = fixed_gains(2, bandwidth, r.period) if bandwidth else SELF_TUNING
    found = run(dict(p) | gains, r)
    return found.z[:, 1] if r.quantity == VELOCITY else found.unknown_input


METHODS = {
    'difference, low-passed': Method(difference, BANDWIDTHS),
    'Savitzky-Golay, causal, degree 2': Method(partial(savitzky_golay, 2), WINDOWS, 'samples'),
    'Savitzky-Golay, causal, degree 3': Method(partial(savitzky_golay, 3), WINDOWS, 'samples'),
    OURS: Method(this_observer),
    FIXED: Method(this_observer, BANDWIDTHS),
}
DRAWN = ('Savitzky-Golay, causal, degree 3', OURS)


def recorded(count: int, changes: Mapping[str, Any] | None = None) -> dict[str, list[Fold]]:
    """Return a fold for each quantity and kind of acceleration; peers are tuned on both kinds."""
    found, p = Family(JOINT | dict(changes or {})).recordings(2 * count), model('encoder')
    folds = {}
    for quantity in (ACCELERATION, VELOCITY):
        rs = [
            Recorded(
                f'simulated {n}', r.t, r.y, np.zeros((len(r.t), 0)),
                r.d if quantity == ACCELERATION else r.z[:, 1], r.t > SETTLED, quantity,
            )
            for n, r in enumerate(found, 1)
        ]  # fmt: skip
        for k, kind in enumerate(KINDS):
            folds[f'{quantity}, {kind}'] = [Fold(p, rs[:count], rs[count + k :: len(KINDS)])]
    return folds


def conditions(_: Path | None) -> tuple[dict[str, list[Fold]], dict[str, float]]:
    """Return the folds; and remarks: what the errors are relative to."""
    folds = recorded(RECORDINGS)
    squares = {
        name: np.mean([np.mean(r.d[r.judged] ** 2) for r in f.judged])
        for name, [f] in folds.items()
    }
    return folds, {f'RMS of {name}': float(np.sqrt(x)) for name, x in squares.items()}


def short() -> dict[str, list[Fold]]:
    """Return a fold of four short recordings."""
    folds = recorded(2, {'duration': 3.0})
    return {'simulated': folds[f'{ACCELERATION}, {KINDS[0]}']}
