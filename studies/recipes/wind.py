# SPDX-License-Identifier: Apache-2.0
"""Wind on a multirotor, from its position and its thrust: flights in RotorPy."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from studies.recipes import peers
from studies.recipes.flight import fly, gusts
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
DATA = None
QUANTITY, SCALE = 'wind along the axis [m/s]', 2.237
SHOWN, SHOWN_FOLD, BAND = (3.0, 23.0), 0, True
DURATION, SETTLED, TUNING, JUDGED = 40.0, 3.0, 2, 4
"""Of a flight (s); flights for tuning and for judging, half of each with steps."""
QUIET = {
    'initial_bias': np.zeros(3), 'noise_density': np.full(3, 1e-4), 'random_walk': np.zeros(3),
}  # fmt: skip
BANDWIDTHS = np.geomspace(1.0, 30.0, 10).tolist()
METHODS = {
    'low-passed second difference less thrust': Method(peers.disturbance_observer, BANDWIDTHS),
    'Kalman filter, wind a random walk': Method(peers.kalman_filter, BANDWIDTHS),
    FIXED: Method(fixed, BANDWIDTHS),
    OURS: Method(self_tuning),
}
DRAWN = ('low-passed second difference less thrust', OURS)


def flight(seed: int) -> list[Recorded]:
    """Return both axes of a flight; d is k times the wind."""
    steps = bool(seed % 2)
    found = fly(DURATION, seed, gusts(seed, steps), QUIET)
    k = model('wind')['constants.k']
    kind = 'steps' if steps else 'turbulence'
    return [
        Recorded(
            f'{kind} {seed}, {name}', found['t'], found['position'][:, axis],
            found['thrust'][:, axis : axis + 1], k * found['wind'][:, axis],
            found['t'] > SETTLED,
        )
        for axis, name in enumerate('xy')
    ]  # fmt: skip


def conditions(_: Path | None) -> tuple[dict[str, list[Fold]], dict[str, float]]:
    """Return the flights with turbulence and those with steps, tuned on both; and remarks."""
    flights = [flight(seed) for seed in range(TUNING + JUDGED)]
    training = [r for both in flights[:TUNING] for r in both]
    judged = {
        name: [r for both in flights[TUNING + odd :: 2] for r in both]
        for odd, name in enumerate(('turbulence', 'steps'))
    }
    return {name: [Fold(model('wind'), training, rs)] for name, rs in judged.items()}, {}


def short() -> dict[str, list[Fold]]:
    """Return a fold of two short simulations of the model alone."""
    p = model('wind')
    both = simulated(p, 2, 100.0, 3.5e-3, (1.5, 1.0), [(0.0, 1.0)], SETTLED)
    return {'simulated': [Fold(p, both[:1], both[1:])]}
