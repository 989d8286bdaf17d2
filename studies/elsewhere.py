# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.elsewhere` measures self-tuning on plants that nothing was made with.

No constant of it was chosen on these plants, and none of our code simulates them: scipy does. It
is told the model. For each recording that judges, a Kalman filter is tuned with the truth of this
very recording, which nobody has.
"""

import argparse
from collections.abc import Callable
import sys
from typing import NamedTuple

from fhaosmo_ros.core import Recording, TriangularModel
import numpy as np
from scipy.integrate import solve_ivp
from studies import evidence
from studies.comparison.methods import METHODS
from studies.comparison.methods.kalman import LINEAR_LIMIT
from studies.comparison.methods.method import Estimates, mean, objective, Setting, tune
from studies.comparison.methods.observers import model_of
from studies.evidence import markdown, Row
from studies.harness import Floats, Found, observed, Results, run_study, SELF_TUNING
from studies.waves import wave

NAME, SEED, SAMPLES = 'elsewhere', 7, 8000
KINDS = ('sine', 'chirp', 'ou', 'square', 'pulses')
NOISES = (0.3, 1.0, 3.0)
"""Factors on the noise of the plant."""


class Plant(NamedTuple):
    """A plant, its d, and its sensor."""

    phi: tuple[str, ...]
    last: Callable[[Floats], float]
    """The same as the last of `phi`, for the simulation."""
    first: float
    """What z1 loses a second, as a share: Phi_1 = -first z1."""
    size: float
    """RMS of d."""
    speed: float
    """rad/s: about how fast d moves."""
    noise: float
    rate: float
    """Hz."""


PLANTS = {
    'drive, rigid': Plant(('0', '-0.8*z2'), lambda z: -0.8 * z[1], 0.0, 5.0, 3.0, 1e-4, 500.0),
    'drive, two masses': Plant(
        ('0', '0', '0', '-40*z3 - 2*z4'), lambda z: -40.0 * z[2] - 2.0 * z[3], 0.0, 50.0, 1.0,
        1e-4, 500.0,
    ),
    'Duffing': Plant(
        ('0', '-0.2*z2 + z1 - z1*z1*z1'), lambda z: -0.2 * z[1] + z[0] - z[0] ** 3, 0.0, 1.0, 2.0,
        1e-3, 200.0,
    ),
    "the paper's": Plant(('0', '0', '-z3'), lambda z: -z[2], 0.0, 0.07, 1.0, 1e-4, 500.0),
    'tank at 10 Hz': Plant(
        ('-0.3*sqrt(abs(z1) + 0.01)',), lambda z: -0.3 * np.sqrt(abs(z[0]) + 0.01), 0.0, 0.2,
        0.05, 5e-3, 10.0,
    ),
    'heater at 4 Hz': Plant(
        ('-0.1*z1', '-0.02*z2'), lambda z: -0.02 * z[1], 0.1, 0.05, 0.02, 0.05, 4.0,
    ),
}  # fmt: skip


def recording(plant: Plant, kind: str, noise: float, samples: int) -> Recording:
    """Return a recording, simulated by scipy with a d that is straight between fine times."""
    random = np.random.default_rng([SEED, *kind.encode()])
    t = np.arange(samples) / plant.rate
    fine = np.arange(10 * samples) / (10.0 * plant.rate)
    d = plant.size * wave(kind, fine, plant.speed, random)
    n = len(plant.phi)

    def rates(time: float, z: Floats) -> Floats:
        out = np.empty(n)
        out[:-1] = z[1:]
        out[-1] = plant.last(z) + np.interp(time, fine, d)
        if n > 1:
            out[0] -= plant.first * z[0]
        return out

    step = 1.0 / plant.rate
    found = solve_ivp(rates, (0.0, t[-1]), np.full(n, 0.2), t_eval=t, max_step=step, rtol=1e-8)
    y = found.y[0] + noise * plant.noise * random.standard_normal(samples)
    return Recording(t, y, np.zeros(samples), found.y.T, np.interp(t, fine, d), kind)


def cell(name: str, noise: float, samples: int, trials: int) -> Row:
    """Return how self-tuning does on a plant, over the Kalman filter."""
    plant = PLANTS[name]
    begin = (samples // 4) / plant.rate  # the first quarter does not count
    setting = Setting(
        TriangularModel(plant.phi), 1.0 / plant.rate, plant.size, noise * plant.noise, begin
    )
    row: Row = {'plant': name, 'noise': noise}
    inside, peaks = [], []
    for r in (recording(plant, kind, noise, samples) for kind in KINDS):
        yard = tune(METHODS[LINEAR_LIMIT], setting, [r], trials, SEED).training
        found = observed(model_of(setting) | SELF_TUNING, r.t, r.y)
        row[r.shape] = objective(r, Estimates(r.z, found.unknown_input), begin) / yard
        away = np.abs(found.unknown_input - r.d) / found.standard_deviation[:, -1]
        inside.append([np.mean((away < k)[r.t >= begin]) for k in (1.0, 1.96)])
        peaks.append(np.abs(found.unknown_input).max() / np.abs(r.d).max())
    row['inside 1 σ'], row['inside 1.96 σ'] = np.mean(inside, axis=0).tolist()
    return {**row, 'largest': max(peaks)}


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return all cells."""
    samples, trials = (2000, 10) if arguments.quick else (SAMPLES, 160)
    calls = {
        (name, noise): (cell, name, noise, samples, trials) for name in PLANTS for noise in NOISES
    }
    rows = evidence.rounded(results(calls).values())
    lines = []
    for name in PLANTS:
        own = [r for r in rows if r['plant'] == name]
        shares = [100.0 * np.mean([r[f'inside {k} σ'] for r in own]) for k in ('1', '1.96')]
        lines.append([
            name, ', '.join(f'{mean([r[k] for k in KINDS]):.2f}' for r in own),
            f'{max(r[k] for r in own for k in KINDS):.2f}', *(f'{x:.0f} %' for x in shares),
            f'{max(r["largest"] for r in own):.2f}',
        ])  # fmt: skip
    every = [r[k] for r in rows for k in KINDS]
    lines.append([
        f'all {len(every)}', f'{mean(every):.2f}',
        f'above 1.25: {sum(ratio > 1.25 for ratio in every)}', '', '', '',
    ])  # fmt: skip
    head = ('plant', 'noise × 0.3, 1, 3', 'worst d', 'within 1 σ', 'within 1.96 σ', 'largest |d|')
    return Found({NAME: rows}, {NAME: markdown(head, lines)}, {})


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
