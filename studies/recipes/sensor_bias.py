# SPDX-License-Identifier: Apache-2.0
"""Bias of a gyroscope, from a heading that has none: flights in RotorPy."""

from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation
from studies.recipes import judging, peers
from studies.recipes.flight import fly, gusts
from studies.recipes.judging import Fold, Method, OURS, Recipe, Recorded

DURATION, SETTLED, TUNING, JUDGED = 60.0, 10.0, 2, 3
OUTLIERS, JUMP = 0.01, 0.5
"""Share of headings that are wrong, by a normal distribution of this standard deviation (rad)."""
GYROSCOPE = {
    'noise_density': np.full(3, 5e-4), 'random_walk': np.full(3, 2e-3),
}  # fmt: skip
BANDWIDTHS = np.geomspace(0.1, 10.0, 11).tolist()


def flight(seed: int) -> Recorded:
    """Return a flight: heading of motion capture, rate of the gyroscope, minus its bias."""
    rng = np.random.default_rng(seed)
    bias = {'initial_bias': rng.uniform(-0.05, 0.05, 3)}
    found = fly(DURATION, seed, gusts(seed, steps=False), GYROSCOPE | bias)
    roll, pitch, yaw = Rotation.from_quat(found['attitude']).as_euler('xyz').T
    t, u = found['t'], np.column_stack([found['rate'][:, 1:], roll, pitch])
    return Recorded(f'flight {seed}', t, np.unwrap(yaw), u, -found['bias'][:, 2], t > SETTLED)


def with_outliers(r: Recorded, seed: int) -> Recorded:
    """Return the recording with some headings that are far off."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(r.t)) < OUTLIERS
    return r._replace(y=r.y + wrong * JUMP * rng.standard_normal(len(r.t)))


def conditions(_: object) -> dict[str, list[Fold]]:
    """Return the flights as simulated, and with outliers."""
    clean = [flight(seed) for seed in range(TUNING + JUDGED)]
    spoilt = [with_outliers(r, seed) for seed, r in enumerate(clean)]
    both, p = {'as simulated': clean, '1 % wrong headings': spoilt}, judging.model('sensor_bias')
    return {name: [Fold(p, rs[:TUNING], rs[TUNING:])] for name, rs in both.items()}


INPUTS = (0.0, 0.3), (0.0, 0.5), (0.0, 0.2), (0.0, 0.2)
RECIPE = Recipe(
    {
        'complementary filter': Method(peers.complementary_filter, BANDWIDTHS),
        'Kalman filter, bias a random walk': Method(peers.kalman_filter, BANDWIDTHS),
        OURS: Method(judging.self_tuning),
    },
    conditions,
    partial(judging.simulated, 'sensor_bias', 100.0, 3.5e-3, (0.05, 0.2), INPUTS, 2.0),
    'bias [rad/s]', ('complementary filter', OURS), (0.0, 60.0), scale=-1.0,
)  # fmt: skip
