# SPDX-License-Identifier: Apache-2.0
"""Load torque of a servo: recordings of BAM (Rhoban), whose load is a mass on a lever."""

from collections.abc import Sequence
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter
from studies.recipes import peers
from studies.recipes.judging import (
    FIXED,
    fixed,
    Fold,
    Method,
    model,
    OURS,
    Recorded,
    self_tuning,
    simulated,
)

Floats = NDArray[np.float64]
DATA = 'folder with the JSON files of one XL330 of BAM'
QUANTITY, SCALE = 'load torque [N m]', 0.00732
"""Inertia (kg m²): mass * g * lever over the identified weight."""
SHOWN, SHOWN_FOLD, BAND = (0.5, 6.0), 3, True
FULL_DUTY, SLIDING = 885.0, 0.3
"""`load` of the servo at full voltage; speed (rad/s) over which Coulomb friction changes sign."""
SETTLED = 0.5
WINDOW = 15
"""Samples of the smoother that identifies the model, offline."""
BANDWIDTHS = np.geomspace(5.0, 200.0, 14).tolist()
METHODS = {
    'disturbance observer': Method(peers.disturbance_observer, BANDWIDTHS),
    'Kalman filter, d a random walk': Method(peers.kalman_filter, BANDWIDTHS),
    FIXED: Method(fixed, BANDWIDTHS),
    OURS: Method(self_tuning),
}
DRAWN = ('disturbance observer', OURS)


def read(path: Path) -> Recorded:
    """Return a recording, still without its truth, for which the inertia is needed."""
    entries = json.loads(path.read_text())['entries']
    t, y, volt, load, powered = (
        np.array([entry[name] for entry in entries], dtype=np.float64)
        for name in ('timestamp', 'position', 'input_volts', 'load', 'torque_enable')
    )
    duty = np.where(load > 2**15, load - 2**16, load) / FULL_DUTY
    u = np.column_stack([duty * volt, powered])
    return Recorded(path.stem, t, y, u, np.zeros_like(t), t > t[0] + SETTLED)


def identify(recordings: Sequence[Recorded]) -> tuple[dict[str, float], Floats, float]:
    """
    Return the model's constants, those of the weight, and what both leave of the weight (RMS).

    y'' = a volt - b powered y' - c tanh(y'/0.3) + w_1 sin y + w_2 cos y by least squares, with
    derivatives by a Savitzky-Golay smoother, which uses the future.
    """
    rows, accelerations = [], []
    for r in recordings:
        t = np.arange(r.t[0], r.t[-1], r.period)
        y, volt, powered = (np.interp(t, r.t, x) for x in (r.y, *r.u.T))
        speed, acceleration = (savgol_filter(y, WINDOW, 3, k, r.period) for k in (1, 2))
        rows.append([volt, -powered * speed, -np.tanh(speed / SLIDING), np.sin(y), np.cos(y)])
        accelerations.append(acceleration)
    table, wanted = np.concatenate(rows, axis=1).T, np.concatenate(accelerations)
    found = np.linalg.lstsq(table, wanted, rcond=None)[0]
    weight = table[:, 3:] @ found[3:]
    left = float(np.sqrt(np.mean((wanted - table @ found) ** 2) / np.mean(weight**2)))
    return dict(zip('abc', found[:3].tolist(), strict=True)), found[3:], left


def with_truth(r: Recorded, weight: Floats) -> Recorded:
    """Return the recording with the weight's torque over the inertia."""
    return r._replace(d=weight[0] * np.sin(r.y) + weight[1] * np.cos(r.y))


def conditions(data: Path) -> tuple[dict[str, list[Fold]], dict[str, float]]:
    """Return folds whose peers are tuned on the other recordings, for two models; and remarks."""
    recordings = [read(path) for path in sorted(data.glob('*.json'))]
    constants, weight, left = identify(recordings)
    known, unseen = [], []
    for k, r in enumerate(recordings):
        others = recordings[:k] + recordings[k + 1 :]
        judged = [with_truth(r, weight)]
        of_others, their_weight, _ = identify(others)
        known.append(
            Fold(model('motor_load', constants), [with_truth(x, weight) for x in others], judged)
        )
        unseen.append(
            Fold(
                model('motor_load', of_others),
                [with_truth(x, their_weight) for x in others],
                judged,
            )
        )
    found = {'model of all': known, 'model of the others': unseen}
    return found, constants | {'weight': float(-weight[0]), 'model_leaves': left}


def short() -> dict[str, list[Fold]]:
    """Return a fold of two short simulations of the file's own motor."""
    p = model('motor_load')
    inputs = (0.0, 2.0), (1.0, 0.0)
    both = simulated(p, 2, 190.0, 4e-4, (25.0, 6.0), inputs, SETTLED, 4.0)
    return {'simulated': [Fold(p, both[:1], both[1:])]}
