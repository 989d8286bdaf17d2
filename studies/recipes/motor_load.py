# SPDX-License-Identifier: Apache-2.0
"""Load torque of a servo: recordings of BAM (Rhoban), whose load is a mass on a lever."""

from collections.abc import Sequence
import json
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter
from studies.harness import Floats
from studies.recipes import judging
from studies.recipes.judging import FIXED, Fold, Method, OURS, Recipe, Recorded

INERTIA = 0.00732  # kg m²: mass * g * lever over the identified weight
FULL_DUTY, SLIDING = 885.0, 0.3
"""`load` of the servo at full voltage; speed (rad/s) over which Coulomb friction changes sign."""
SETTLED = 0.5
WINDOW = 15  # samples of the smoother that identifies the model, offline
BANDWIDTHS = np.geomspace(5.0, 200.0, 14).tolist()


def read(path: Path) -> Recorded:
    """Return a recording, still without its truth, for which the inertia is needed."""
    entries = json.loads(path.read_text())['entries']
    t, y, volt, load, powered = (
        np.array([entry[name] for entry in entries], dtype=np.float64)
        for name in ('timestamp', 'position', 'input_volts', 'load', 'torque_enable')
    )
    duty = np.where(load > 2**15, load - 2**16, load) / FULL_DUTY
    u = np.column_stack([duty * volt, powered])
    return Recorded(path.stem, t, y, u, np.zeros_like(t), SETTLED)


def identify(recordings: Sequence[Recorded]) -> tuple[dict[str, float], Floats]:
    """
    Return the model's constants, and those of the weight.

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
    table = np.concatenate(rows, axis=1).T
    found = np.linalg.lstsq(table, np.concatenate(accelerations), rcond=None)[0]
    return dict(zip('abc', found[:3].tolist(), strict=True)), found[3:]


def conditions(data: Path) -> dict[str, list[Fold]]:
    """Return folds whose peers are tuned on the other recordings, for two models."""
    recordings = [read(path) for path in sorted(data.glob('*.json'))]
    everything = identify(recordings)

    def fold(k: int, own: Floats, constants: dict[str, float], weight: Floats) -> Fold:
        """Return a fold that judges one recording by its own weight and tunes by another."""
        both = [
            r._replace(d=w[0] * np.sin(r.y) + w[1] * np.cos(r.y))
            for n, r in enumerate(recordings)
            for w in [own if n == k else weight]
        ]
        return Fold(judging.model('motor_load', constants), both[:k] + both[k + 1 :], [both[k]])

    numbers = range(len(recordings))
    others = [identify(recordings[:k] + recordings[k + 1 :]) for k in numbers]
    return {
        'model of all': [fold(k, everything[1], *everything) for k in numbers],
        'model of the others': [fold(k, everything[1], *others[k]) for k in numbers],
    }


RECIPE = Recipe(
    {
        'disturbance observer': Method(judging.disturbance_observer, BANDWIDTHS),
        'Kalman filter, d a random walk': Method(judging.kalman_filter, BANDWIDTHS),
        FIXED: Method(judging.this_observer, BANDWIDTHS),
        OURS: Method(judging.this_observer),
    },
    conditions, 'load torque [N m]', ('disturbance observer', OURS), (0.5, 6.0), scale=INERTIA,
    fold=3,
    data='folder with the JSON files of one XL330 of BAM',
)  # fmt: skip
