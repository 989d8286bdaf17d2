# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.events` measures how late events are, and how many are false alarms.

A joint, z1' = z2, z2' = -z2 + d, whose angle is measured at 100 Hz. d is a small load that is
always there, and faults are added to it: steps of 1 for 2 s. False alarms are counted over ten
hours without faults, delays over one with them, for several thresholds. The filter beside the
self-tuning estimator is the usual Kalman filter, whose d is a random walk; it is told the noise,
and the intensity of d is the one with the least delay at one false alarm an hour, found on other
recordings.
"""

import argparse
from collections.abc import Sequence
import sys
from typing import Any, NamedTuple

from fhaosmo_ros import core
from fhaosmo_ros.core import EventDetector, Observer, TriangularModel
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.plot.figures import COLOURS
from matplotlib.figure import Figure
import numpy as np
from scipy.signal import lfilter
from studies import evidence
from studies.evidence import Row
from studies.harness import Floats, Found, Results, run_study, SELF_TUNING
from studies.methods import estimates, SampledModel

NAME = 'events'
H, NOISE, LOAD, FAULT, LASTS, EVERY, SETTLED = 0.01, 1e-3, 0.05, 1.0, 2.0, 20.0, 60.0
HOURS, QUICK_HOURS = 10.0, 0.5
MODEL: dict[str, Any] = {'order': 2, 'phi': ['0', '-z2']}
THRESHOLDS = np.geomspace(0.08, 0.9, 14)
DEVIATIONS, DURATION = 5.0, 0.03
FACTORS, NEVER = (1.0, 3.0), 0.05
INTENSITIES = np.geomspace(1e-3, 1e1, 9)
FILTER, OURS = 'Kalman filter', 'self-tuning'


class Recording(NamedTuple):
    """y and d at 100 Hz, and the begins of the faults in seconds."""

    y: Floats
    d: Floats
    faults: Floats


Estimate = tuple[Floats, Floats]  # d and its standard deviation


def record(hours: float, seed: int, noise: float = NOISE, faults: bool = False) -> Recording:
    """Simulate the joint exactly, d being constant between samples."""
    rng = np.random.default_rng(seed)
    count = int(hours * 3600.0 / H)
    t = H * np.arange(count)
    rates, phases = rng.uniform(0.2, 1.0, 5), rng.uniform(0.0, 2.0 * np.pi, 5)
    d = LOAD * np.sqrt(0.4) * sum(np.sin(w * t + p) for w, p in zip(rates, phases, strict=True))
    begins = np.zeros(0)
    if faults:
        begins = np.arange(SETTLED, t[-1] - EVERY, EVERY)
        begins = np.round((begins + rng.uniform(0.0, EVERY - 2.0 * LASTS, len(begins))) / H) * H
        for begin, sign in zip(begins, rng.choice([-1.0, 1.0], len(begins)), strict=True):
            d[(t >= begin - H / 2) & (t < begin + LASTS - H / 2)] += sign * FAULT
    e = np.exp(-H)
    z2 = lfilter([0.0, 1.0 - e], [1.0, -e], d)
    z1 = np.cumsum(np.concatenate([[0.0], ((1.0 - e) * z2 + (H - 1.0 + e) * d)[:-1]]))
    return Recording(z1 + noise * rng.standard_normal(count), d, begins)


def kalman(y: Floats, intensity: float) -> Estimate:
    """Return what the filter says whose d is a random walk; it has no standard deviation."""
    model = TriangularModel(MODEL['phi'])
    gain = SampledModel(model, H).kalman(intensity / NOISE**2)
    t, none = H * np.arange(len(y)), np.zeros(len(y))
    samples = core.Recording(t, y, none, none[:, None], none, FILTER)
    return estimates(model, gain, 0.0, samples, 1.5 * H)[:, model.order], none


def self_tuning(y: Floats) -> Estimate:
    """Return what an observer says that is told the model and no more."""
    observer, parts = Observer(MODEL | SELF_TUNING), []
    for part in np.array_split(np.arange(len(y)), max(1, len(y) // 100_000)):
        found = observer.run(np.round(part * H * 1e9).astype(np.int64), y[part])
        parts.append((found.unknown_input, found.standard_deviation[:, -1]))
    d, deviation = map(np.concatenate, zip(*parts, strict=True))
    return d, deviation


def alarms(d: Floats, deviation: Floats, **settings: float) -> Floats:
    """Return the times at which events begin, after the first minute."""
    detector = EventDetector(ESTIMATOR_PARAMETERS.defaults() | settings)
    stamps, found = np.round(1e9 * H * np.arange(len(d))).astype(np.int64), []
    for part in np.array_split(np.arange(len(d)), max(1, len(d) // 10_000)):
        detector.take(stamps[part], d[part], deviation[part])
        found += [event.stamp * 1e-9 for event in detector.taken() if event.begins]
    times = np.array(found)
    return times[times > SETTLED]


def delays(begun: Floats, faults: Floats) -> Floats:
    """Return how long after the begin of each fault an event began; infinite if none did."""
    found = np.append(begun, np.inf)[np.searchsorted(begun, faults)]
    return np.where(found - faults < LASTS, found - faults, np.inf)


class Point(NamedTuple):
    """One threshold: events an hour without faults, median delay (s), share of faults found."""

    threshold: float
    false: float
    delay: float
    found: float


def points(
    name: str, intensity: float, factor: float, seed: int, quiet_hours: float, hours: float
) -> list[Point]:
    """
    Return a point for each threshold of an estimator, at the noise times a factor.

    False alarms are counted over `quiet_hours` without faults, delays over `hours` with them.
    """
    noise = factor * NOISE
    recordings = record(quiet_hours, seed, noise), record(hours, seed + 1, noise, faults=True)
    quiet, faulty = (
        kalman(r.y, intensity) if name == FILTER else self_tuning(r.y) for r in recordings
    )
    found, faults = [], recordings[1].faults
    for threshold in THRESHOLDS.tolist():
        own = {
            'event_threshold': threshold, 'event_duration': DURATION,
            'event_deviations': 0.0 if name == FILTER else DEVIATIONS,
        }  # fmt: skip
        late = delays(alarms(*faulty, **own), faults)
        false = len(alarms(*quiet, **own)) / (quiet_hours - SETTLED / 3600.0)
        median, share = float(np.median(late)), float(np.mean(np.isfinite(late)))
        found.append(Point(threshold, false, median, share))
    return found


def best(points: Sequence[Point], false: float = 1.0) -> Point:
    """Return the point of least delay with at most so many false alarms an hour."""
    fit = [p for p in points if p.false <= false and p.found > 0.99]
    return min(fit, key=lambda p: p.delay) if fit else points[-1]


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return a line for each factor on the noise, estimator and threshold."""
    hours = QUICK_HOURS if arguments.quick else HOURS
    few = 0.1 * hours
    tried = results({q: (points, FILTER, q, 1.0, 11, few, few) for q in INTENSITIES.tolist()})
    intensity = min(tried, key=lambda q: best(tried[q]).delay)
    cells = [(factor, name) for factor in FACTORS for name in (FILTER, OURS)]
    found = results({(f, name): (points, name, intensity, f, 1, hours, few) for f, name in cells})
    rows = evidence.rounded(
        {
            'noise': factor * NOISE, 'estimator': name,
            'intensity': intensity if name == FILTER else None, **point._asdict(),
        }
        for factor, name in cells
        for point in found[factor, name]
    )  # fmt: skip
    return Found({NAME: rows}, {}, {NAME: draw(rows)})


def points_of(rows: Sequence[Row], factor: float, name: str) -> list[Point]:
    """Return the points of an estimator at the noise times a factor."""
    return [
        Point(*(row[field] for field in Point._fields))
        for row in rows
        if row['estimator'] == name and round(row['noise'] / NOISE, 3) == factor
    ]


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the delay over the false alarms, a panel for each noise."""
    figure = Figure(figsize=(9.5, 4.2), layout='constrained')
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for factor, axes in zip(FACTORS, panels, strict=True):
        for colour, name in zip(COLOURS, (FILTER, OURS), strict=False):
            shown = [p for p in points_of(rows, factor, name) if p.found > 0.9]
            x, y = [max(p.false, NEVER) for p in shown], [p.delay for p in shown]
            axes.plot(x, y, 'o-', color=colour, markersize=4, label=name)
        told = ', nothing told' if factor > 1.0 else ''
        axes.set(
            title=f'noise of {factor * NOISE:g} rad{told}', xscale='log',
            xlabel=f'false alarms an hour (leftmost: none in {HOURS:g} hours)',
        )  # fmt: skip
        axes.grid(alpha=0.3)
    panels[0].set(ylabel='median delay [s]', ylim=(0.0, None))
    panels[0].legend()
    return figure


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
