# SPDX-License-Identifier: Apache-2.0
"""
Start, upsets, outliers and other rates: presets and self-tuning observers beside Kalman filters.

The Kalman filters know the true sizes of the noise, of the states and of d, and have the model of
d that the preset has. Their bandwidth is scanned on a recording without upsets.
"""

from collections.abc import Callable, Sequence
from copy import copy
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import (
    OBSERVER_PARAMETERS,
    ONLINE_PARAMETERS,
    PLANT_PARAMETERS,
)
from fhaosmo_ros.core.simulation.plant import Plant
from kalman_filter import KalmanFilter
import numpy as np
from numpy.typing import NDArray
from studies.document import refill
from studies.model import model_alone, SELF_TUNING
from table import Row, Table

Floats = NDArray[np.float64]
CONFIG = Path(__file__).resolve().parents[1] / 'config'
NOISE = {
    'noise_1e-2': 1e-2, 'noise_1e-3': 1e-3, 'noise_1e-4': 1e-4, 'paper_plant': 1e-5,
    'pendulum': 5e-4, 'dc_motor': 4.4e-4, 'demo': 3e-6, 'levant': 3e-6, 'paper': 3e-6,
}  # fmt: skip
"""
Standard deviation of the noise on y that each preset is for; of dc_motor: of its quantum; of the
last three, which are for a y without noise: of what the jitter of stamps is like.
"""
SELF_TUNED = ('noise_1e-3', 'pendulum', 'dc_motor')
"""For the plants of these, an observer that is told nothing but the model, too."""
LENGTH, HIT = 16.0, 6.0
"""Seconds of a run, and when the upset begins."""
SETTLED = 3.0
"""From then on the error of a clean run is the usual one."""


WRONG = 'peak at the start, sizes wrong'
START, UPSET, LATE = 'peak at the start', 'peak after an upset', 'seconds to the usual error'
SMALL = 'peak after an offset of 3 or 5 sigma'
PLAIN = 'error with outliers over that of the Kalman filter'
LEAST = 'the same of the filter that is told the outliers'
ROBUST = 'error with outliers over that of the best robust one'
STUDENT = 'error with Student t noise over that of the best robust one'
BARS = {
    START: 1.5, WRONG: 1.5, UPSET: 2.0, SMALL: None, LATE: 0.3,
    PLAIN: 0.6, LEAST: None, ROBUST: 1.0, STUDENT: 1.0,
}  # fmt: skip
"""Worst values of the node over all files, and what is allowed."""
TOLD = 'Kalman, told the outliers'
"""What nobody has: it shows how much can be gained."""
SMALL_SIZES, SIZES = (3.0, 5.0), (7.0, 10.0, 100.0, 1e3, 1e4)
"""Offsets of y, in standard deviations of the noise."""
PAGE = CONFIG.parent / 'docs' / 'operation.md'
SHOWN = {
    'start': 'start', 'plant reset': 'plant set back by 3 s',
    'offset 1, 0.5 s': 'y 1 off for 0.5 s',
}  # fmt: skip
"""Upsets that the page shows."""


class Case(NamedTuple):
    """Samples (t in s), the truth of d, when the upset is over, and 1 where y is an outlier."""

    t: Floats
    y: Floats
    d: Floats
    back: float = 0.0
    outliers: Floats | None = None


class Preset:
    """
    A parameter file, the plant in it, and the noise that it is for.

    Parameters
    ----------
    path : Path
    self_tuning : bool
        Whether the estimator is told nothing but the model in the file.

    Attributes
    ----------
    estimator : dict
        Online parameters.
    tuned : dict
        Those of the file.
    sigma : float
        Standard deviation of the noise on y.

    """

    def __init__(self, path: Path, self_tuning: bool = False) -> None:
        self.name = f'{path.stem}, self-tuning' if self_tuning else path.stem
        self.estimator = self.tuned = load(path, 'estimator', ONLINE_PARAMETERS)
        if self_tuning:
            self.estimator = model_alone(self.tuned) | SELF_TUNING
        self.sigma = NOISE[path.stem]
        values = load(path, 'plant')
        self._plant = {k: v for k, v in values.items() if k in PLANT_PARAMETERS}
        if not self._plant.get('quantisation'):
            self._plant['noise_std'] = 0.0
        self.quantised = bool(self._plant.get('quantisation'))
        self.clean = self.case()

    def case(self, factor: float = 1.0, noise: Callable[[Any, int], Floats] | None = None) -> Case:
        """Return a clean run, at `factor` times the usual rate, with some noise."""
        t = np.arange(round(LENGTH * 1000 * factor)) / (1000.0 * factor)
        truth = Plant(self._plant).simulate(t)
        random = np.random.default_rng(7)
        if noise is not None:
            extra = self.sigma * noise(random, len(t))
        else:
            extra = (not self.quantised) * self.sigma * random.standard_normal(len(t))
        return Case(t, truth.y + extra, truth.unknown_input)

    def offset(self, size: float, seconds: float) -> Case:
        """Return a run in which y is `size` off for some time."""
        t, y, d, *_ = self.clean
        wrong = (t >= HIT) & (t < HIT + seconds)
        return Case(t, y + size * wrong, d, HIT + seconds)

    def reset(self) -> Case:
        """Return a run in which the plant goes back in its motion by 3 s: all states jump."""
        t, y, d, *_ = self.clean
        at, back = np.searchsorted(t, HIT), np.searchsorted(t, HIT - 3.0)
        order = np.concatenate([np.arange(at), np.arange(back, len(t))])[: len(t)]
        return Case(t, y[order], d[order], HIT)

    def outliers(self, share: float, size: float, length: int = 1) -> Case:
        """Return a run with bursts of `length` outliers of either sign."""
        t, y, d, *_ = self.clean
        random, y, outliers = np.random.default_rng(8), y.copy(), np.zeros(len(t))
        for k in np.flatnonzero(random.random(len(t)) < share / length):
            y[k : k + length] += size * self.sigma * random.choice([-1.0, 1.0])
            outliers[k : k + length] = 1.0
        return Case(t, y, d, outliers=outliers)

    def lost(self, share: float) -> Case:
        """Return a run of which some samples are lost at random."""
        keep = np.random.default_rng(9).random(len(self.clean.t)) >= share
        t, y, d, *_ = self.clean
        return Case(t[keep], y[keep], d[keep])


def presets() -> list[Preset]:
    """Return the tuned presets, the others, and the self-tuning ones."""
    paths = {path.stem: path for path in CONFIG.glob('**/*.yaml') if path.stem in NOISE}
    found = [Preset(paths[name]) for name in NOISE]
    return found + [Preset(paths[name], self_tuning=True) for name in SELF_TUNED]


def in_node(p: Preset, case: Case) -> tuple[Floats, OnlineEstimator]:
    """Return the estimates of d by the path of the node."""
    estimator = OnlineEstimator(p.estimator)
    stamps = 10**9 + np.round(case.t * 1e9).astype(np.int64)
    return estimator.run(stamps, case.y, np.zeros(len(case.t))).unknown_input, estimator


def bare(p: Preset, case: Case) -> Floats:
    """Return the estimates of d by the class Observer alone."""
    values = {k: v for k, v in p.estimator.items() if k in OBSERVER_PARAMETERS}
    return Observer(values).run(case.t, case.y).unknown_input


def kalman(p: Preset) -> KalmanFilter:
    """Return the best Kalman filter with the preset's model of d on the clean run."""
    e, truth = p.tuned, p.clean.d
    d = float(np.sqrt(np.mean(truth**2)))
    noise = max(p.sigma, 1e-9)
    decays = [e.get('unknown_input_decay') or 1.0]
    derivatives = e.get('unknown_input_derivatives', 0)
    found = [
        KalmanFilter(e, decays[0], derivatives, noise, factor * d)
        for factor in np.geomspace(0.1, 30.0, 11)
    ]
    return min(found, key=lambda f: rms(f.run(p.clean.t, p.clean.y) - truth, p.clean.t))


def rms(error: Floats, t: Floats, begin: float = SETTLED) -> float:
    """Return the RMS from `begin` on."""
    return float(np.sqrt(np.mean(error[t >= begin] ** 2)))


def time_to_usual(error: Floats, case: Case, usual: float) -> float:
    """Return for how long after the upset the error is sometimes larger than the largest usual."""
    late = case.t[(np.abs(error) > usual) & (case.t >= case.back)]
    return float(late[-1] - case.back) if len(late) else 0.0


def methods(p: Preset) -> dict[str, Callable[[Case], Floats]]:
    """Return what is compared, by name."""
    best = kalman(p)
    return {
        'node': lambda c: in_node(p, c)[0],
        'bare': lambda c: bare(p, c),
        'Kalman': lambda c: best.run(c.t, c.y),
        'Huber': lambda c: best.run(c.t, c.y, huber=2.5),
        'Kalman, loss test': lambda c: best.run(c.t, c.y, lost=True),
        TOLD: lambda c: best.run(c.t, c.y, outliers=c.outliers),
    }


def upset_cases(p: Preset, quick: bool) -> dict[str, Case]:
    """Return the upsets by name; peak and time to the usual error are judged."""
    cases = {'start': p.clean, 'plant reset': p.reset(), 'offset 1, 0.5 s': p.offset(1.0, 0.5)}
    cases |= offsets(p, SIZES[:: 3 if quick else 1], quick)
    return cases


def offsets(p: Preset, sizes: Sequence[float], quick: bool) -> dict[str, Case]:
    """Return runs in which y is so many standard deviations off, for three times."""
    return {
        f'{size:g} sigma, {seconds:g} s': p.offset(size * p.sigma, seconds)
        for size in sizes
        for seconds in (0.02, 0.5, 5.0)[:: 2 if quick else 1]
    }


def wrong_sizes(p: Preset) -> dict[str, Preset]:
    """Return the preset with one of its sizes wrong at a time, by what is wrong."""
    found = {}
    for name, factor in (('noise_size', 3.0), ('state_sizes', 10.0), ('unknown_input_size', 3.0)):
        for times in (factor, 1.0 / factor) if name in p.estimator else ():
            other, right = copy(p), p.estimator[name]
            wrong = [times * x for x in right] if isinstance(right, list) else times * right
            other.estimator = {**p.estimator, name: wrong}
            found[f'start, {name} x {times:.2g}'] = other
    return found


def steady_cases(p: Preset) -> dict[str, Case]:
    """Return runs whose RMS error is judged, by name."""
    cases = {'clean': p.clean}
    for size in (10.0, 50.0, 1000.0):
        cases[f'1 % of {size:g} sigma'] = p.outliers(0.01, size)
    for length in (5, 20):
        cases[f'1 %, bursts of {length}, 50 sigma'] = p.outliers(0.01, 50.0, length)
    cases['Student t, 3'] = p.case(noise=lambda r, n: r.standard_t(3.0, n))
    for factor in (0.1, 0.5, 2.0):
        cases[f'rate x {factor:g}'] = p.case(factor)
    cases['half lost'] = p.lost(0.5)
    return cases


class Judged:
    """The worst value of each bar and file, and in which case it is."""

    def __init__(self) -> None:
        self._worst: dict[tuple[str, str], tuple[float, str]] = {}

    def add(self, bar: str, file: str, value: float, case: str) -> None:
        """Take a value of a case."""
        found = (float(value), f'{file}, {case}')
        self._worst[bar, file] = max(self._worst.get((bar, file), found), found)

    def rows(self) -> list[Row]:
        """Return the worst of all files."""
        found = {b: max(v for (name, _), v in self._worst.items() if name == b) for b in BARS}
        return [Row(name, found[name][0], '', bar, found[name][1]) for name, bar in BARS.items()]

    def table(self) -> Table:
        """Return a line for each bar, a column for each file."""
        files = list(dict.fromkeys(file for _, file in self._worst))
        lines = []
        for name, bar in BARS.items():
            found = (self._worst.get((name, file)) for file in files)
            cells = ('-' if worst is None else f'{worst[0]:.2f}' for worst in found)
            lines.append((name, '-' if bar is None else f'{bar:g}', *cells))
        return Table('Worst values by file.', ('', 'allowed', *files), lines)


def measure(quick: bool) -> list[Row | Table]:
    """Return the bars, the worst values by file, and the two tables."""
    upsets, steady, judged = [], [], Judged()
    with np.errstate(all='ignore'):
        for p in presets():
            runs = methods(p)
            usual = {
                name: float(np.abs((run(p.clean) - p.clean.d)[p.clean.t > SETTLED]).max())
                for name, run in runs.items()
            }
            largest = float(np.abs(p.clean.d).max())
            small = offsets(p, SMALL_SIZES, quick)
            for title, case in (upset_cases(p, quick) | small).items():
                line = [p.name, title]
                for name, run in runs.items():
                    error = run(case) - case.d
                    peak = np.abs(error[case.t >= (HIT if case.back else 0.0)]).max() / largest
                    late = time_to_usual(error, case, 1.1 * usual[name])
                    line.append(f'{peak:.2g} {late:.2g}')
                    if name == 'node' and title in small:
                        judged.add(SMALL, p.name, peak, title)
                    elif name == 'node':
                        judged.add(UPSET if case.back else START, p.name, peak, title)
                        judged.add(LATE, p.name, late, title)
                upsets.append(tuple(line))
            for title, other in wrong_sizes(p).items():
                line, case = [p.name, title], p.clean
                for run in (in_node(other, case)[0], bare(other, case)):
                    error = run - case.d
                    peak = float(np.abs(error).max() / largest)
                    late = time_to_usual(error, case, 1.1 * usual['node'])
                    line.append(f'{peak:.2g} {late:.2g}')
                    judged.add(WRONG, p.name, peak, title)
                upsets.append((*line, *['-'] * (len(runs) - 2)))
            for title, case in steady_cases(p).items():
                size = rms(p.clean.d, p.clean.t)
                found = [rms(run(case) - case.d, case.t) / size for run in runs.values()]
                if '%' in title:
                    judged.add(PLAIN, p.name, found[0] / found[2], title)
                    judged.add(LEAST, p.name, found[5] / found[2], title)
                    judged.add(ROBUST, p.name, found[0] / min(found[3:5]), title)
                elif 'Student' in title:
                    judged.add(STUDENT, p.name, found[0] / min(found[3:5]), title)
                steady.append((p.name, title, *(f'{value:.3g}' for value in found)))
    return [
        *judged.rows(),
        judged.table(),
        Table(
            'Upsets: largest error of d over the largest d, and seconds from the end of the upset '
            'until the error is the usual one for good.',
            ('preset', 'upset', *runs),
            upsets,
        ),
        Table('RMS error of d over RMS of d.', ('preset', 'case', *runs), steady),
    ]


def page(results: Sequence[Row | Table]) -> None:
    """Write the tables of the page."""
    bars, upsets, _ = (t for t in results if isinstance(t, Table))
    shown = {
        file: [line[2].replace(' ', ', ') for line in upsets.lines
               if line[0] == file and line[1] in SHOWN]
        for file in dict.fromkeys(line[0] for line in upsets.lines)
    }  # fmt: skip
    lines = [(file, *cells) for file, cells in shown.items()]
    refill(PAGE, {
        'upsets': Table('', ('', *SHOWN.values()), lines).markdown(), 'bars': bars.markdown(),
    })  # fmt: skip
