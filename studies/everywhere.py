# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.everywhere` measures: tuned once, used everywhere.

Estimators of d that are tuned for one condition, or told only the model, in many conditions;
beside a Kalman filter that is tuned anew with the truth for each.
"""

import argparse
import math
import sys
from typing import NamedTuple

from fhaosmo_ros.core import Recording, TriangularModel
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from fhaosmo_ros.core.simulation.plant import quantised, respond
from fhaosmo_ros.tools.cli.command import shipped
import numpy as np
from scipy.signal import lfilter
from studies import evidence
from studies.evidence import markdown, Row
from studies.harness import Found, observed, Results, run_study, SELF_TUNING
from studies.methods import (
    HUBER,
    IMM,
    LINEAR_LIMIT,
    mean,
    METHODS,
    NOISE,
    objective,
    Setting,
    trial,
    tune,
    Values,
)
from studies.waves import wave

NAME = 'everywhere'
STEP, RATE, SEED = 5e-4, 1000.0, 1


class Plant(NamedTuple):
    """A plant, its d and noise as tuned, and its sensor."""

    phi: tuple[str, ...]
    size: float  # RMS of d
    speed: float  # about how fast d moves (rad/s)
    noise: float
    rate: float = RATE  # Hz
    start: tuple[float, ...] = ()
    file: str = ''  # the shipped one


PLANTS = {
    "paper's plant": Plant(
        ('0', '0', '-z3'), 0.07, 1.0, 1e-3, start=(0.2, 0.2, 0.2), file='config/noise_1e-3.yaml',
    ),
    'pendulum': Plant(
        ('0', '-19.62*sin(z1) - 0.3*z2 - 0.5*tanh(z2/0.1)'), 2.8, 2.0, 5e-4, start=(0.5, 0.0),
        file='config/models/pendulum.yaml',
    ),
    'motor': Plant(
        ('0', '-25*z2'), 70.0, 3.0, 4.4e-4, start=(0.0, 0.0), file='config/models/dc_motor.yaml',
    ),
}  # fmt: skip


class Condition(NamedTuple):
    """What differs from the condition of the tuning; factors, but for `rate` and `kind`."""

    noise: float = 1.0
    later: float = 1.0  # on the noise of the second half
    rate: float = RATE
    speed: float = 1.0
    size: float = 1.0
    phi: float = 1.0  # on the functions that the estimators are told; the plant stays
    kind: str = 'white'


TUNED = 'as tuned'
CONDITIONS = {
    TUNED: Condition(),
    'noise x 10': Condition(noise=10.0),
    'noise / 10': Condition(noise=0.1),
    'noise x 10 from the middle on': Condition(later=10.0),
    'noise x 100 from the middle on': Condition(later=100.0),
    'rate / 2': Condition(rate=500.0),
    'rate x 2': Condition(rate=2000.0),
    '100 Hz': Condition(rate=100.0),
    'd 3 times as fast': Condition(speed=3.0),
    'd 10 times as fast': Condition(speed=10.0),
    'd x 10': Condition(size=10.0),
    'told Phi + 30 %': Condition(phi=1.3),
    'told Phi - 30 %': Condition(phi=0.7),
    'Student t noise': Condition(kind='student'),
    '1 % outliers of 50 sigma': Condition(kind='outliers'),
    'y in steps of 5 sigma': Condition(kind='steps'),
    'noise AR(1), 0.75': Condition(kind='0.75'),
    'noise AR(1), 0.9': Condition(kind='0.9'),
    'y off by 1 for 0.5 s': Condition(kind='off'),
}
SELF, ONCE, PRESET = 'self-tuning', 'Kalman, tuned once', 'shipped file'
STYLES = {
    SELF: evidence.SELF, ONCE: evidence.USUAL, PRESET: evidence.TUNED, HUBER: evidence.ROBUST,
    NOISE: evidence.OTHER, IMM: evidence.GREY,
}  # fmt: skip
ANEW, KNOWN = 'tuned anew', 'every z known'
"""
Errors of d: of the Kalman filter tuned for the condition, all others are over this; and what a
wrong Phi makes of d, whoever estimates it.
"""


class Size(NamedTuple):
    """How much is computed."""

    duration: float = 20.0
    kinds: tuple[str, ...] = ('sine', 'chirp', 'ou', 'square', 'pulses')
    plants: tuple[str, ...] = tuple(PLANTS)
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    trials: int = 160


QUICK = Size(7.0, ('sine', 'ou'), ('motor',), (TUNED, 'noise x 10'), 24)


def at(member: Values, order: int, rate: float) -> dict[str, float]:
    """Return the values of a Kalman filter for `RATE` at a rate: the intensity of d stays."""
    quicker = (rate / RATE) ** (0.5 / (order + 1 + member['derivatives']))  # D 17
    return {**member, 'bandwidth': member['bandwidth'] * quicker}


def recording(
    plant: Plant, c: Condition, kind: str, duration: float, seed: int = SEED
) -> Recording:
    """Return a recording of the plant; its seeds are this one and the kind of d."""
    random = np.random.default_rng([seed, *kind.encode()])
    table = wave(kind, np.arange(0.0, duration + STEP, STEP), plant.speed * c.speed, random)
    t = np.arange(round(duration * c.rate)) / c.rate
    z, d = respond(TriangularModel(plant.phi), plant.start, t, plant.size * c.size * table, STEP,
                   step=STEP)  # fmt: skip
    v, sigma, half = random.standard_normal(len(t)), plant.noise * c.noise, len(t) // 2
    if c.kind == 'student':
        v = random.standard_t(3, len(t)) / math.sqrt(3.0)
    elif c.kind == 'outliers':
        v[random.uniform(size=len(t)) < 0.01] *= 50.0
    elif c.kind.startswith('0.'):
        a = float(c.kind)
        v = lfilter([math.sqrt(1.0 - a * a)], [1.0, -a], v)
    v[half:] *= c.later
    y = z[:, 0] + sigma * v
    if c.kind == 'steps':
        y = quantised(z[:, 0], 5.0 * sigma)
    elif c.kind == 'off':
        y[half : half + round(0.5 * c.rate)] += 1.0
    return Recording(t, y, np.zeros(len(t)), z, d, kind)


def setting_of(plant: Plant, c: Condition) -> Setting:
    """Return what the estimators are told in a condition."""
    told = [text if c.phi == 1.0 else f'{c.phi} * ({text})' for text in plant.phi]
    return Setting(TriangularModel(told), 1.0 / c.rate, plant.size, plant.noise)


def implied(plant: Plant, c: Condition, recordings: list[Recording]) -> float:
    """Return the error of the d that a wrong Phi implies, where every z is known exactly."""
    phi = TriangularModel(plant.phi)
    off = [(1.0 - c.phi) * np.array([phi.evaluate(z)[-1] for z in r.z]) for r in recordings]
    return mean(objective(r, r.d + e) for r, e in zip(recordings, off, strict=True))


class SelfTuned(NamedTuple):
    """How self-tuning does, by recording."""

    errors: list[float]
    inside: list[float]  # mean shares of d within 1 and 1.96 deviations
    largest: float  # |d|, over the largest true one


def self_tuned(setting: Setting, recordings: list[Recording]) -> SelfTuned:
    """Run the self-tuning estimator, which is told only the model."""
    errors, inside, largest, since = [], [], 0.0, setting.judged_from
    for r in recordings:
        found = observed(setting.told | SELF_TUNING, r)
        d = found.unknown_input
        errors.append(objective(r, d, since))
        away = np.abs(d - r.d) / found.standard_deviation[:, -1]
        inside.append([np.mean((away < k)[r.t >= since]) for k in (1.0, 1.96)])
        largest = max(largest, np.abs(d).max() / np.abs(r.d).max())
    return SelfTuned(errors, np.mean(inside, axis=0).tolist(), largest)


def cell(name: str, condition: str, size: Size, once: Values | None) -> tuple[Row, Values]:
    """Return the errors of all methods in a condition; without `once` tune them here."""
    plant, c = PLANTS[name], CONDITIONS[condition]
    recordings = [recording(plant, c, kind, size.duration) for kind in size.kinds]
    setting = setting_of(plant, c)
    anew = tune(METHODS[LINEAR_LIMIT], setting, recordings, size.trials, SEED)
    once = once or anew.values
    values = at(once, setting.model.order, c.rate)
    preset = load(shipped(plant.file), 'estimator', ONLINE_PARAMETERS) | setting.told
    of_preset = (objective(r, observed(preset, r).unknown_input) for r in recordings)
    ours = self_tuned(setting, recordings)
    found = {
        SELF: mean(ours.errors),
        ONCE: trial(METHODS[LINEAR_LIMIT], setting, values, recordings).value,
        PRESET: mean(of_preset),
    }
    row: Row = {'plant': name, 'condition': condition, ANEW: anew.value}
    row |= {method: value / anew.value for method, value in found.items()}
    row[KNOWN] = implied(plant, c, recordings) / anew.value if c.phi != 1.0 else None
    row['inside 1 σ'], row['inside 1.96 σ'] = (round(share, 3) for share in ours.inside)
    return row, once


def number(ratio: float) -> str:
    """Return a ratio as text."""
    return f'{ratio:.2f}' if ratio < 10.0 else f'{ratio:,.0f}' if ratio < 1e4 else 'diverges'


def texts(cells: list[Row]) -> dict[str, str]:
    """Return the part of the page."""
    lines = []
    for name in [name for name in STYLES if name in cells[0]]:
        found = [c[name] for c in cells]
        worst = max(cells, key=lambda c, name=name: c[name])
        where = f'{number(max(found))} ({worst["plant"]}, {worst["condition"]})'
        bad = f'{sum(ratio > 1.25 for ratio in found)} of {len(cells)}'
        lines.append([name, number(mean(found)), where, bad])
    return {'methods': markdown(['method', 'geometric mean', 'worst', 'cells above 1.25'], lines)}


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return all cells; those of the tuning are computed first."""
    size = QUICK if arguments.quick else Size()
    keys = [(p, c) for p in size.plants for c in size.conditions]
    found = results({(p, c): (cell, p, c, size, None) for p, c in keys if c == TUNED})
    once = {p: found[p, TUNED][1] for p in size.plants}
    found |= results({(p, c): (cell, p, c, size, once[p]) for p, c in keys if c != TUNED})
    # What filters of earlier got is as in the table before.
    table = evidence.read(NAME, arguments.output)
    before = {(row['plant'], row['condition']): row for row in table}
    cells = evidence.rounded(before.get(key, {}) | found[key][0] for key in keys)
    panels: dict[str, dict[str, Row]] = {p: {} for p in size.plants}
    for row in cells:
        panels[row['plant']][row['condition']] = row
    text = 'error of d over that of a Kalman filter tuned anew with the truth'
    return Found({NAME: cells}, texts(cells), {NAME: evidence.draw_ratios(panels, STYLES, text)})


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
