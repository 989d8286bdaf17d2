# SPDX-License-Identifier: Apache-2.0
"""Wind on a multirotor, from its position and its thrust: flights in RotorPy."""

from functools import partial

import numpy as np
from studies.recipes import judging, peers
from studies.recipes.flight import fly, gusts
from studies.recipes.judging import FIXED, Fold, Method, OURS, Recipe, Recorded

DURATION, SETTLED, TUNING, JUDGED = 40.0, 3.0, 2, 4
"""Of a flight (s); flights for tuning and for judging, half of each with steps."""
QUIET = {
    'initial_bias': np.zeros(3), 'noise_density': np.full(3, 1e-4), 'random_walk': np.zeros(3),
}  # fmt: skip
BANDWIDTHS = np.geomspace(1.0, 30.0, 10).tolist()


def flight(seed: int) -> list[Recorded]:
    """Return both axes of a flight; d is k times the wind."""
    steps = bool(seed % 2)
    found = fly(DURATION, seed, gusts(seed, steps), QUIET)
    k = judging.model('wind')['constants.k']
    kind = 'steps' if steps else 'turbulence'
    return [
        Recorded(
            f'{kind} {seed}, {name}', found['t'], found['position'][:, axis],
            found['thrust'][:, axis : axis + 1], k * found['wind'][:, axis],
            found['t'] > SETTLED,
        )
        for axis, name in enumerate('xy')
    ]  # fmt: skip


def conditions(_: object) -> dict[str, list[Fold]]:
    """Return the flights with turbulence and those with steps, tuned on both."""
    flights = [flight(seed) for seed in range(TUNING + JUDGED)]
    training = [r for both in flights[:TUNING] for r in both]
    quiet, steps = ([r for f in flights[TUNING + odd :: 2] for r in f] for odd in (0, 1))
    p = judging.model('wind')
    return {'turbulence': [Fold(p, training, quiet)], 'steps': [Fold(p, training, steps)]}


RECIPE = Recipe(
    {
        'low-passed second difference less thrust': Method(peers.disturbance_observer, BANDWIDTHS),
        'Kalman filter, wind a random walk': Method(peers.kalman_filter, BANDWIDTHS),
        FIXED: Method(judging.fixed, BANDWIDTHS),
        OURS: Method(judging.self_tuning),
    },
    conditions,
    partial(judging.simulated, 'wind', 100.0, 3.5e-3, (1.5, 1.0), [(0.0, 1.0)], SETTLED),
    'wind along the axis [m/s]', ('low-passed second difference less thrust', OURS), (3.0, 23.0),
    scale=2.237,
)  # fmt: skip
