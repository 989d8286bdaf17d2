# SPDX-License-Identifier: Apache-2.0
"""Velocity and acceleration of a joint from its encoder: simulations with 4096 counts a turn."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from fhaosmo_ros.core import Family
import numpy as np
from scipy.signal import lfilter, savgol_coeffs
from studies.harness import Floats
from studies.recipes import judging
from studies.recipes.judging import FIXED, Fold, Method, OURS, Recipe, Recorded, VELOCITY

ACCELERATION = 'acceleration'
KINDS = ('smooth', 'steps')  # of acceleration, as `disturbances` below has them in turn
JOINT = {
    'order': 2, 'phi': ['0', '0'], 'duration': 8.0, 'sample_rate': 1000.0, 'initial_state': 0.0,
    'quantisation': 2 * np.pi / 4096, 'noise_std': 0.0, 'rms_of_d': 20.0, 'band_of_d': [2.0, 15.0],
    'disturbances': ['sines', 'steps'], 'step_interval': 0.5,
}  # fmt: skip
SETTLED, RECORDINGS = 1.0, 4  # s; recordings for tuning, and as many for judging
BANDWIDTHS = np.geomspace(10.0, 500.0, 25).tolist()
WINDOWS = [float(window) for window in range(11, 202, 10)]


def difference(_: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return differences behind a first-order low pass; of the velocity for the acceleration."""
    order = 1 if r.quantity == VELOCITY else 2
    return judging.low_passed(r.y, bandwidth, r.period, order, order)


def savitzky_golay(degree: int, _: Mapping[str, Any], r: Recorded, window: float) -> Floats:
    """Return the derivative, at the newest sample, of a polynomial through the last ones."""
    count, derivative = round(window), 1 if r.quantity == VELOCITY else 2
    weights = savgol_coeffs(count, degree, derivative, r.period, pos=count - 1)
    return np.asarray(lfilter(weights, [1.0], r.y))


def conditions(_: None) -> dict[str, list[Fold]]:
    """Return a fold for each quantity and kind of acceleration; peers are tuned on both kinds."""
    found, p = Family(JOINT).recordings(2 * RECORDINGS), judging.model('encoder')
    folds = {}
    for quantity in (ACCELERATION, VELOCITY):
        rs = [
            Recorded(
                f'simulated {n}', r.t, r.y, np.zeros((len(r.t), 1)),
                r.d if quantity == ACCELERATION else r.z[:, 1], SETTLED, quantity,
            )
            for n, r in enumerate(found, 1)
        ]  # fmt: skip
        for k, kind in enumerate(KINDS):
            judged = rs[RECORDINGS + k :: len(KINDS)]
            folds[f'{quantity}, {kind}'] = [Fold(p, rs[:RECORDINGS], judged)]
    return folds


RECIPE = Recipe(
    {
        'difference, low-passed': Method(difference, BANDWIDTHS),
        'Savitzky-Golay, causal, degree 2': Method(partial(savitzky_golay, 2), WINDOWS, 'samples'),
        'Savitzky-Golay, causal, degree 3': Method(partial(savitzky_golay, 3), WINDOWS, 'samples'),
        OURS: Method(judging.this_observer),
        FIXED: Method(judging.this_observer, BANDWIDTHS),
    },
    conditions, 'acceleration [rad/s²]', ('Savitzky-Golay, causal, degree 3', OURS), (2.0, 4.0),
    band=False,
)  # fmt: skip
