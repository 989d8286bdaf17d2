# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.elsewhere` measures self-tuning on other plants than `everywhere`.

Its rules for jumps of d and of y were chosen on these plants with other seeds, no other constant
was; scipy integrates them, not our code. It is told the model. For each recording that judges, a
Kalman filter is tuned with the truth of this very recording, which nobody has.
"""

import argparse
import sys

from fhaosmo_ros.core import Recording, TriangularModel
import numpy as np
from scipy.integrate import solve_ivp
from studies import evidence
from studies.everywhere import Plant, self_tuned
from studies.evidence import markdown, Row
from studies.harness import Floats, Found, Results, run_study
from studies.methods import LINEAR_LIMIT, mean, METHODS, Setting, tune
from studies.waves import wave

NAME, SEED, SAMPLES = 'elsewhere', 13, 8000
KINDS = ('sine', 'chirp', 'ou', 'square', 'pulses')
NOISES = (0.3, 1.0, 3.0)  # factors on the noise of the plant
PLANTS = {
    'drive, rigid': Plant(('0', '-0.8*z2'), 5.0, 3.0, 1e-4, 500.0),
    'drive, two masses': Plant(('0', '0', '0', '-40*z3 - 2*z4'), 50.0, 1.0, 1e-4, 500.0),
    'Duffing': Plant(('0', '-0.2*z2 + z1 - z1**3'), 1.0, 2.0, 1e-3, 200.0),
    "the paper's": Plant(('0', '0', '-z3'), 0.07, 1.0, 1e-4, 500.0),
    'tank at 10 Hz': Plant(('-0.3*sqrt(abs(z1) + 0.01)',), 0.2, 0.05, 5e-3, 10.0),
    'heater at 4 Hz': Plant(('-0.1*z1', '-0.02*z2'), 0.05, 0.02, 0.05, 4.0),
}


def recording(plant: Plant, kind: str, noise: float, samples: int) -> Recording:
    """Return a recording, integrated by scipy with a d that is straight between fine times."""
    random = np.random.default_rng([SEED, *kind.encode()])
    t = np.arange(samples) / plant.rate
    fine = np.arange(10 * samples) / (10.0 * plant.rate)
    d = plant.size * wave(kind, fine, plant.speed, random)
    model = TriangularModel(plant.phi)

    def rates(time: float, z: Floats) -> Floats:
        after = np.append(z[1:], np.interp(time, fine, d))
        return np.asarray(after + model.evaluate(z))

    start, step = np.full(model.order, 0.2), 1.0 / plant.rate
    found = solve_ivp(rates, (0.0, t[-1]), start, t_eval=t, max_step=step, rtol=1e-8)
    y = found.y[0] + noise * plant.noise * random.standard_normal(samples)
    return Recording(t, y, np.zeros(samples), found.y.T, np.interp(t, fine, d), kind)


def cell(name: str, noise: float, samples: int, trials: int) -> Row:
    """Return how self-tuning does on a plant, over the Kalman filter."""
    plant = PLANTS[name]
    begin = (samples // 4) / plant.rate  # the first quarter does not count
    setting = Setting(
        TriangularModel(plant.phi), 1.0 / plant.rate, plant.size, noise * plant.noise, begin
    )
    recordings = [recording(plant, kind, noise, samples) for kind in KINDS]
    ours = self_tuned(setting, recordings)
    yards = [tune(METHODS[LINEAR_LIMIT], setting, [r], trials, SEED).value for r in recordings]
    ratios = {k: e / yard for k, e, yard in zip(KINDS, ours.errors, yards, strict=True)}
    shares = dict(zip(('inside 1 σ', 'inside 1.96 σ'), ours.inside, strict=True))
    return {'plant': name, 'noise': noise, **ratios, **shares, 'largest': ours.largest}


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
