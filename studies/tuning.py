# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.tuning` measures what docs/tuning.md says of tune: bags, presets.

bags: gains that `tune --bag` finds without the truth, on other recordings of the same kind, beside
a Kalman filter that is tuned with the truth of these. presets: config/noise_*.yaml on held-out
recordings, beside Kalman filters whose model of d (a random walk; a decaying one) and bandwidth
were scanned on the presets' own training recordings.
"""

import argparse
from collections.abc import Callable
import json
from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core import Recording
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.fuzzy import curves
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import (
    ESTIMATOR_PARAMETERS,
    OBSERVER_PARAMETERS,
    ONLINE_PARAMETERS,
)
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.cli.progress import progress
from fhaosmo_ros.tools.cli.share import shipped
from fhaosmo_ros.tools.tuning.bag_checks import refuse, refuse_unseen
from fhaosmo_ros.tools.tuning.bag_gains import make_gains
from fhaosmo_ros.tools.tuning.identify import identify_input
from fhaosmo_ros.tools.tuning.linear_gains import kalman_like, SampledModel
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.sensor import identify
from fhaosmo_ros.tools.tuning.source import RecordedOutput, simulated
from fhaosmo_ros.tools.tuning.start import SCHEME
import numpy as np
from studies import everywhere
from studies.comparison.evaluation import METHODS, tune
from studies.comparison.methods.linear import LINEAR_LIMIT
from studies.comparison.methods.method import Setting
from studies.document import refill
from studies.everywhere import Condition

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'tuning.md'

KINDS = {'sine': 'sine', 'ou': 'Ornstein-Uhlenbeck', 'square': 'square wave'}
BAGS = {
    "paper's plant": ("paper's plant", Condition(), 0.0),
    'the same, d ten times as large': ("paper's plant", Condition(size=10.0), 0.0),
    'the same, d ten times slower': ("paper's plant", Condition(speed=0.1), 20.0),
    'pendulum': ('pendulum', Condition(), 0.0),
    'motor': ('motor', Condition(), 0.0),
}
"""Plant, what differs from its usual condition, and seconds of judging recordings left out: a
steady-state Kalman filter for a slow d takes so long to start."""
BAG, JUDGED, SEEDS = 60.0, 30.0, (2, 3)
"""Duration of a bag and of the recordings that judge (s); seeds of these."""
FILTER_TRIALS = 80

NOISES, RECORDINGS = ('1e-4', '1e-3', '1e-2'), 36
WIDE, LINEAR = 1e4, 1e-5
"""Half-width in units of the noise, and gamma, at which predict_correct is the linear filter."""
DECAYS = (0.0, *np.geomspace(0.2, 5.0, 5).tolist())
BANDWIDTHS = np.geomspace(1.5, 40.0, 17).tolist()
Tick = Callable[[], object]


def found_in(r: Recording, model: dict[str, Any]) -> dict[str, Any]:
    """Return the gains that `tune --bag` finds in y."""
    values = ESTIMATOR_PARAMETERS.complete(model)
    data = RecordedOutput(r.t, r.y, np.zeros((len(r.t), 1)), identify(r.t, r.y))
    found = identify_input(data, TriangularModel.of(values), values, model)
    refuse(found)
    gains = make_gains(found, model)
    refuse_unseen(found, gains)
    return gains.parameters


def gains_of_bag(name: str, kind: str) -> dict[str, Any]:
    """Return what is found in the bag of a case."""
    plant, c = everywhere.PLANTS[BAGS[name][0]], BAGS[name][1]
    model = {'order': len(plant.phi), 'phi': list(plant.phi)}
    return found_in(everywhere.recording(plant, c, kind, BAG), model)


def judging(name: str, kind: str) -> list[Recording]:
    """Return the recordings that judge a case; what is before t = 0 does not count."""
    plant, c, late = everywhere.PLANTS[BAGS[name][0]], *BAGS[name][1:]
    rs = [everywhere.recording(plant, c, kind, JUDGED + late, seed) for seed in SEEDS]
    return [r._replace(t=r.t - late) for r in rs]


def error_with(gains: dict[str, Any], recordings: list[Recording]) -> float:
    """Return the error of d of the estimator with these gains."""
    return everywhere.mean([
        everywhere.error(r, everywhere.online(r._replace(t=r.t - r.t[0]), gains)[0])
        for r in recordings
    ])  # fmt: skip


def least_error(setting: Setting, recordings: list[Recording]) -> float:
    """Return the error of d of the Kalman filter that is tuned with the truth, as compared."""
    method = METHODS[LINEAR_LIMIT]
    values = tune(method, setting, recordings, FILTER_TRIALS, everywhere.SEED).values
    run = method.prepare(setting, values)
    return everywhere.mean([everywhere.error(r, run(r)['filtered'].d) for r in recordings])


def bags(tick: Tick) -> dict[str, Any]:
    """Return the errors by case and kind of d, and the ratios; also with the gains of the sine."""
    results: dict[str, Any] = {}
    for name, (plant, c, _) in BAGS.items():
        setting = everywhere.setting_of(everywhere.PLANTS[plant], c)
        rows = results.setdefault(name, {})
        of_sine = gains_of_bag(name, 'sine')
        for kind in KINDS:
            recordings = judging(name, kind)
            own = of_sine if kind == 'sine' else gains_of_bag(name, kind)
            yard = least_error(setting, recordings)
            error, other = error_with(own, recordings), error_with(of_sine, recordings)
            rows[kind] = {
                'error': _kept(error), 'ratio': _kept(error / yard),
                'ratio with the gains of the sine': _kept(other / yard),
            }  # fmt: skip
            tick()
    return results


def bags_table(results: dict[str, Any]) -> str:
    """Return the table, and what it comes to."""
    lines = [f'| bag | {" | ".join(KINDS.values())} | geometric mean |', '|---' * 5 + '|']
    ratios = []
    for name, rows in results.items():
        own = [rows[kind]['ratio'] for kind in KINDS]
        cells = [f'{rows[kind]["error"]:.3f} ({rows[kind]["ratio"]:.2f})' for kind in KINDS]
        lines.append(f'| {name} | {" | ".join(cells)} | {everywhere.mean(own):.2f} |')
        ratios += own
    usual = [name for name, (_, c, _) in BAGS.items() if c == Condition()]
    crossed = {
        text: ', '.join(
            f'{results[name][kind]["ratio with the gains of the sine"]:.1f} ({name})'
            for name in usual
        )
        for kind, text in KINDS.items()
        if kind != 'sine'
    }
    total = (
        f'Over all {len(ratios)} the ratio is {everywhere.mean(ratios):.2f}, at worst '
        f'{max(ratios):.2f}. With the gains of the bag whose d is a sine it is, where d is'
    )
    return '\n'.join([*lines, '', total, '', *(f'- {k}: {row}.' for k, row in crossed.items())])


def presets(tick: Tick) -> dict[str, Any]:
    """Return error and objective on held-out recordings, by noise."""
    return {noise: presets_at(noise, tick) for noise in NOISES}


def presets_at(noise: str, tick: Tick, scan: bool = True) -> dict[str, Any]:
    """Return those for one noise; `scan`: also of the Kalman filters."""
    values = TUNE_PARAMETERS.complete(
        {'noise_std': float(noise), 'recordings': RECORDINGS, 'held_out': RECORDINGS}
    )
    data = simulated(values, 1)
    training = Objective(data.training, dict(SCHEME), values, choose=False)

    def judged(estimator: dict[str, Any], given: dict[str, Any]) -> list[float]:
        found = Objective(data.held_out, estimator, values, False, training.scale)(given)
        return [_kept(found.error), _kept(found.objective)]

    row = {
        title: judged(load(shipped(f'config/{name}.yaml'), 'estimator', ONLINE_PARAMETERS), {})
        for title, name in (('preset', f'noise_{noise}'), ('demo.yaml', 'demo'))
    }
    if scan:
        scores = {}
        for decay in DECAYS:
            for width in BANDWIDTHS:
                point = decay, width
                scores[point] = training(linear_gains(float(noise), *point)).objective
            tick()
        walks = [p for p in scores if p[0] == 0.0]
        for title, points in (('Kalman, random walk', walks), ('Kalman, decaying', [*scores])):
            best = min(points, key=scores.__getitem__)
            row[title] = judged(dict(SCHEME), linear_gains(float(noise), *best))
    return row


def linear_gains(noise: float, decay: float, bandwidth: float) -> dict[str, Any]:
    """Return the observer that is the Kalman filter (D 19)."""
    defaults = TUNE_PARAMETERS.defaults()
    period = 1.0 / defaults['sample_rate']
    plant = TriangularModel.of(defaults)
    model = SampledModel(plant, period, decay=decay)
    width = WIDE * noise
    psi = curves(OBSERVER_PARAMETERS.defaults(), model.size)
    return {
        'unknown_input_decay': decay, 'correction_period': period, 'fuzzy_widths': [width],
        'lambda': kalman_like(model, bandwidth, width, psi, noise, LINEAR).tolist(),
        'gamma_initial': LINEAR, 'gamma_min': LINEAR,
    }  # fmt: skip


def presets_table(results: dict[str, Any]) -> str:
    """Return the table."""
    titles = list(next(iter(results.values())))
    lines = [f'| noise | {" | ".join(titles)} |', '|---' * (1 + len(titles)) + '|']
    for noise, row in results.items():
        cells = [f'{error:.3f} ({objective:.3f})' for error, objective in row.values()]
        lines.append(f'| {noise} | {" | ".join(cells)} |')
    return '\n'.join(lines)


PARTS: dict[str, tuple[Callable[[Tick], dict[str, Any]], Callable[[dict[str, Any]], str], int]] = {
    'bags': (bags, bags_table, len(BAGS) * len(KINDS)),
    'presets': (presets, presets_table, len(NOISES) * len(DECAYS)),
}
"""What measures a part, what makes its table, and how many steps the first one has."""


def texts(results: dict[str, Any]) -> dict[str, str]:
    """Return the generated parts of the page."""
    return {name: table(results[name]) for name, (_, table, _) in PARTS.items()}


def _kept(x: float) -> float:
    return float(f'{x:.5g}')


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""

    def body(arguments: argparse.Namespace, stop: Stop) -> None:
        path = PAGE.with_suffix('.json')
        results = json.loads(path.read_text('utf-8')) if path.exists() else {}
        with stop.raising():
            for name in [arguments.only] if arguments.only else PARTS:
                measure, _, total = PARTS[name]
                with progress(total=total, unit='step', desc=name) as bar:
                    results[name] = measure(bar.update)
            for made in refill(PAGE, texts(results), results=results):
                print(made)

    parser = argparse.ArgumentParser(prog='tuning', description=__doc__)
    parser.add_argument('--only', choices=PARTS, help='one part; the others stay')
    return run_command(parser, argv, body)


if __name__ == '__main__':
    sys.exit(main())
