# SPDX-License-Identifier: Apache-2.0
"""Compare the observer with what people would use instead, all tuned by the same rules."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
import math
import sys
from typing import Any, NamedTuple

from fhaosmo_ros.core import Family, Recording, TriangularModel
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import FAMILY_PARAMETERS, SHAPES
from fhaosmo_ros.tools.cli.command import shipped
from matplotlib.figure import Figure
import numpy as np
from studies import evidence, methods
from studies.evidence import markdown, Row
from studies.harness import Floats, Found, Results, run_study
from studies.methods import KINDS, LINEAR, mean, METHODS, objective, Outcome, Setting, tune
from studies.waves import wave

NOISES, RATES = (0.0, 1e-4, 1e-3, 1e-2), (1000.0, 100.0)
TIMINGS: dict[str, dict[str, float]] = {
    'even': {},
    'jitter': {'period_jitter': 0.2},  # in periods
    'dropouts': {'dropout': 0.1, 'dropout_length': 0.05},  # the length in seconds
    'outliers': {'outliers': 0.01, 'outlier_std': 50.0},  # in standard deviations of the noise
}
JUMPS = ('steps', 'sawtooth', 'impulses', 'stick-slip')
STAND_IN = 'chirp'  # shape that `Unseen` replaces
STEP = 5e-4
"""Of the simulations, in seconds: Runge-Kutta steps whose error is far below any estimate's."""
TRAINING_SEED, HELD_OUT_SEED, HELD_OUT = 1, 1001, 6
FEW_SAMPLES, MORE = 300.0, 3  # below this rate (Hz) training has so many times the recordings


class Disturbance(NamedTuple):
    """A kind of d: its shape in the tuning, and on the recordings that judge; rad/s."""

    trained: str
    judged: str  # of the family's, or of waves.py, which no tuning sees
    band: tuple[float, float] = (0.5, 8.0)


class PlantCase(NamedTuple):
    """A plant of config/models, and how its d and its noise are scaled."""

    text: str
    file: str
    rms_of_d: float
    rms_of_u: float
    relative: bool  # noise in units of y's amplitude instead of absolutely
    disturbances: dict[str, Disturbance]


SMOOTH = {
    name: Disturbance('sines', judged)
    for name, judged in (
        ('mix', 'sines'), ('chirp', 'chirp'), ('noise', 'ou'), ('pulses', 'pulses'),
    )
}  # fmt: skip
JUMPING = {name: Disturbance('steps', name) for name in JUMPS}
SINES = {
    'low sine': Disturbance('sines', 'sine', (0.3, 2.0)),
    'high sine': Disturbance('sines', 'sine', (4.0, 10.0)),
}
PLANTS = {
    'paper': PlantCase(
        "the paper's plant", 'paper_plant', 0.07, 0.0, False, SINES | SMOOTH | JUMPING
    ),
    'pendulum': PlantCase('pendulum', 'pendulum', 2.5, 0.0, True, SMOOTH | JUMPING),
    'motor': PlantCase('DC motor', 'dc_motor', 70.0, 1.0, True, SMOOTH | JUMPING),
}


class Unseen(Family):
    """A family, whose shape is `STAND_IN`, with a d of waves.py at `omega` rad/s in its place."""

    def __init__(self, parameters: Mapping[str, Any], kind: str, omega: float) -> None:
        super().__init__(parameters)
        self._kind, self._omega = kind, omega

    def _wave(self, shape: str, t: Floats, random: np.random.Generator) -> Floats:
        if shape == STAND_IN:
            return wave(self._kind, t, self._omega, random)
        return super()._wave(shape, t, random)


class Sensor(NamedTuple):
    """A plant, its kinds of d, and how y is sampled. Methods are tuned once for each sensor."""

    plant: str  # key of `PLANTS`
    disturbances: tuple[str, ...]  # keys of the plant's
    noise: float  # standard deviation on y; see `PlantCase.relative`
    rate: float  # Hz
    timing: str = 'even'  # key of `TIMINGS`

    def setting(self) -> Setting:
        """Return what a user knows before tuning."""
        case = PLANTS[self.plant]
        values = load(shipped(f'config/models/{case.file}.yaml'), 'plant', PLANT_PARAMETERS)
        model = TriangularModel.of(PLANT_PARAMETERS.complete(values))
        # An encoder's rounding is spread evenly over a quantum.
        noise = math.hypot(self._noise(), values.get('quantisation', 0.0) / math.sqrt(12.0))
        return Setting(model, 1.0 / self.rate, case.rms_of_d, noise)

    @lru_cache(maxsize=2)  # noqa: B019  (a named tuple is its own key; few are kept)
    def training(self, count: int) -> list[Recording]:
        """
        Return the recordings that the tuning sees.

        More of them where they have few samples, fewer where no noise has to be averaged.
        """
        kinds = PLANTS[self.plant].disturbances
        shapes = sorted({kinds[name].trained for name in self.disturbances})
        count *= MORE if self.rate < FEW_SAMPLES else 1
        if self.setting().noise == 0.0:
            count = max(1, count // 2)
        family = Family(self._family(shapes, kinds[self.disturbances[0]].band))
        return family.recordings(count, TRAINING_SEED)

    @lru_cache(maxsize=6)  # noqa: B019
    def held_out(self, disturbance: str, count: int = HELD_OUT) -> list[Recording]:
        """Return the recordings that judge."""
        _, judged, band = PLANTS[self.plant].disturbances[disturbance]
        if judged in SHAPES:
            return Family(self._family((judged,), band)).recordings(count, HELD_OUT_SEED)
        omegas = band[0] * (band[1] / band[0]) ** ((np.arange(count) + 0.5) / count)
        values = self._family((STAND_IN,), band)
        return [
            Unseen(values, judged, omega).recording(k, HELD_OUT_SEED)
            for k, omega in enumerate(omegas.tolist())
        ]

    def _noise(self) -> float:
        return self.noise * (amplitude(self.plant) if PLANTS[self.plant].relative else 1.0)

    def _family(self, shapes: Sequence[str], band: tuple[float, float]) -> dict[str, Any]:
        noise = self._noise()
        units = {
            'period_jitter': 1.0 / self.rate, 'dropout_length': self.rate, 'outlier_std': noise,
        }  # fmt: skip
        timing = {k: v * units.get(k, 1.0) for k, v in TIMINGS[self.timing].items()}
        return family_values(self.plant) | timing | {
            'disturbances': list(shapes), 'band_of_d': list(band), 'noise_std': noise,
            'sample_rate': self.rate,
        }  # fmt: skip


@lru_cache
def family_values(plant: str) -> dict[str, Any]:
    """Return the parameters of a plant's family that do not depend on the sensor."""
    case = PLANTS[plant]
    sizes = {'rms_of_d': case.rms_of_d, 'rms_of_u': case.rms_of_u, 'integration_step': STEP}
    return load(shipped(f'config/models/{case.file}.yaml'), 'plant', FAMILY_PARAMETERS) | sizes


@lru_cache
def amplitude(plant: str) -> float:
    """Return half the range of y without noise, averaged over some recordings."""
    both = {'disturbances': ['sines', 'steps'], 'sample_rate': 100.0}
    family = Family(family_values(plant) | both)
    return float(np.mean([np.ptp(r.y) / 2.0 for r in family.recordings(4, TRAINING_SEED)]))


def sensors(quick: bool = False) -> list[Sensor]:
    """Return all sensors of the comparison, the ones that cost most first."""
    if quick:
        return [
            Sensor('paper', ('steps', 'impulses'), 1e-3, 100.0),
            Sensor('paper', ('low sine',), 0.0, 100.0),
            Sensor('motor', ('mix', 'steps', 'pulses'), 1e-3, 100.0),
        ]
    chosen, smooth, jumping = [], tuple(SMOOTH), tuple(JUMPING)
    for rate in RATES:
        for noise in NOISES:
            # Without noise gains for steps are deadbeat, and gains for smooth d are not.
            groups = (smooth, jumping) if noise == 0.0 else ((*smooth, *jumping),)
            of_paper = *((name,) for name in SINES), smooth, jumping
            chosen += [Sensor('paper', names, noise, rate) for names in of_paper]
            chosen += [
                Sensor(p, names, noise, rate) for p in ('pendulum', 'motor') for names in groups
            ]
    for timing in ('jitter', 'dropouts', 'outliers'):
        chosen += [Sensor('paper', (name,), 1e-3, 1000.0, timing) for name in ('mix', 'steps')]
    return chosen


def evaluate(sensor: Sensor, name: str, count: int, trials: int) -> tuple[Outcome, list[float]]:
    """Tune a method for a sensor and return its error for each of the sensor's disturbances."""
    method, setting = METHODS[name], sensor.setting()
    tuned = tune(method, setting, sensor.training(count), trials, seed=1)
    run = method.prepare(setting, tuned.values)
    return tuned, [
        mean(objective(r, run(r)[:, -1]) for r in sensor.held_out(disturbance))
        for disturbance in sensor.disturbances
    ]


NAME = 'comparison'
FULL, QUICK = (4, 200), (1, 15)  # recordings that tune a method, and trials
STYLES = {
    methods.USUAL: evidence.USUAL, methods.ADAPTIVE: evidence.ROBUST,
    methods.SLIDING: evidence.OTHER, methods.PAPER: evidence.GREY, methods.OURS: evidence.TUNED,
    methods.SELF_TUNING: evidence.SELF,
}  # fmt: skip
KIND = {name: method.kind for name, method in METHODS.items()} | methods.EARLIER
KEY = 6  # columns that say what was measured: a cell, and the method
CLOSE = 0.05  # errors within this part of another one count as equal


class Cell(NamedTuple):
    """Plant, kind of d, standard deviation of the noise on y, samples a second, timing."""

    plant: str
    d: str
    noise: float
    rate: float
    timing: str

    @property
    def jumps(self) -> bool:
        """True for a d that jumps."""
        return self.d in JUMPS


Chosen = dict[Cell, dict[str, float]]  # errors of d by cell and kind of method

GROUPS = {
    'd without jumps': (True, False), 'd with jumps': (True, True),
    'no noise, without jumps': (False, False), 'no noise, with jumps': (False, True),
}  # fmt: skip
"""Whether there is noise, and whether d jumps."""


def best_of_kinds(rows: Iterable[Row]) -> Chosen:
    """Return for each cell the method of each kind whose error in training is smallest."""
    chosen: Chosen = {}
    for row in sorted(rows, key=lambda row: row['training']):
        errors = chosen.setdefault(Cell(*(row[name] for name in Cell._fields)), {})
        errors.setdefault(KIND[row['method']], row['error'])
    return chosen


def ratios(chosen: Chosen, kind: str, about: Callable[[Cell], bool]) -> list[float]:
    """Return the errors of d over those of the best linear filter, of the cells with both."""
    both = [errors for cell, errors in chosen.items() if about(cell) and kind in errors]
    return [errors[kind] / errors[LINEAR] for errors in both]


def texts(rows: Iterable[Row]) -> dict[str, str]:
    """Return the part of the page: ratios by kind and group, and how often a kind is the best."""
    chosen, lines = best_of_kinds(rows), []

    def spread(values: list[float]) -> str:  # geometric mean, and the largest
        return f'{number(mean(values))} ({number(max(values))})' if values else ''

    for kind in KINDS:
        parts = [
            ratios(chosen, kind, lambda c, group=group: (c.noise > 0.0, c.jumps) == group)
            for group in GROUPS.values()
        ]
        best = sum(
            kind in errors and errors[kind] <= (1.0 + CLOSE) * min(errors.values())
            for errors in chosen.values()
        )
        shown = ['1' if kind == LINEAR else spread(part) for part in parts]
        lines.append([kind, *shown, f'{best} of {len(chosen)}'])
    head = ['', *GROUPS, f'at most {100.0 * CLOSE:g} % behind the best']
    return {'summary': markdown(head, lines)}


def number(x: float) -> str:
    """Return a number as text."""
    if not x < 1e6:
        return '∞'
    if x >= 100.0:
        return f'{x:.3g}' if x < 1e4 else f'{x:.0e}'
    return f'{x:.2g}' if x < 0.1 else f'{x:.2f}'


def draw(chosen: Chosen, jumps: bool) -> Figure:
    """Draw each kind's error over that of the best linear filter, for d with or without jumps."""
    groups: dict[str, dict[str, list[Cell]]] = {case.text: {} for case in PLANTS.values()}
    for c in sorted(chosen, key=lambda c: (c.timing != 'even', c.timing, -c.rate, c.noise)):
        if c.jumps == jumps:
            rate = '1 kHz' if c.rate == 1000.0 else f'{c.rate:g} Hz'
            timing = '' if c.timing == 'even' else f', {c.timing}'
            row = f'{rate}{timing}, {f"noise {c.noise:g}" if c.noise else "no noise"}'
            groups[PLANTS[c.plant].text].setdefault(row, []).append(c)
    panels = {
        plant: {
            text: {
                kind: mean(values)
                for kind in STYLES
                if (values := ratios(chosen, kind, cells.__contains__))
            }
            for text, cells in rows.items()
        }
        for plant, rows in groups.items()
        if rows
    }
    with_jumps = 'with' if jumps else 'without'
    text = f'd {with_jumps} jumps: error of d over that of the best linear filter'
    return evidence.draw_ratios(panels, STYLES, text)


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return a line for each cell and method; what was not measured is as in the table before."""
    quick, only = arguments.quick, arguments.method
    training, trials = QUICK if quick else FULL
    found = results({
        (sensor, name): (evaluate, sensor, name, training, trials)
        for sensor in sensors(quick)
        for name in METHODS
        if only in (None, name)
    })  # fmt: skip
    rows = evidence.rounded(
        Cell(s.plant, d, s.noise, s.rate, s.timing)._asdict()
        | {'method': name, 'training': tuned.value, 'error': error}
        for (s, name), (tuned, errors) in found.items()
        for d, error in zip(s.disturbances, errors, strict=True)
    )
    anew = {tuple(row.values())[:KEY]: row for row in rows}
    before = evidence.read(NAME, arguments.output)
    rows = [anew.pop(tuple(row.values())[:KEY], row) for row in before] + [*anew.values()]
    chosen = best_of_kinds(rows)
    drawn = {'comparison_smooth': draw(chosen, False), 'comparison_jumps': draw(chosen, True)}
    return Found({NAME: rows}, texts(rows), drawn)


if __name__ == '__main__':
    only = {'choices': METHODS, 'metavar': 'NAME', 'help': 'what to measure anew (default: all)'}
    sys.exit(run_study(NAME, __doc__, measure, options=[('--method', only)]))
