# SPDX-License-Identifier: Apache-2.0
"""Compare the observer with what people would use instead, all tuned by the same rules."""

import argparse
import os
from pathlib import Path
from typing import Any

from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.cli.processes import Workers
from fhaosmo_ros.tools.cli.progress import progress
from studies import evidence
from studies.comparison import figures
from studies.comparison.cells import Sensor, sensors
from studies.comparison.evaluation import evaluate, METHODS, methods_for
from studies.comparison.results import best_of_kinds, Cell, texts
from studies.evidence import Row

NAME = 'comparison'
TRIALS, QUICK_TRIALS = 200, 15
TRAINING, QUICK_TRAINING = 4, 1


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""
    parser = argparse.ArgumentParser(prog='compare', description=__doc__)
    parser.add_argument(
        '--quick', action='store_true', help='a few cells and trials, for a first look'
    )
    parser.add_argument('--trials', type=_positive, metavar='N', help='trials of each tuning')
    parser.add_argument(
        '--only', choices=list(METHODS), metavar='METHOD',
        help='measure this method anew, and take the others from the results that are there',
    )  # fmt: skip
    parser.add_argument(
        '--jobs', type=_positive, metavar='N', default=os.cpu_count() or 1,
        help='processes (default: one a core)',
    )  # fmt: skip
    parser.add_argument(
        '--output', type=Path, metavar='FOLDER',
        help='folder for results and figures (default: docs; comparison_output with --quick)',
    )  # fmt: skip
    return run_command(parser, argv, _compare)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'expected an integer >= 1, got {text}')
    return value


def _compare(arguments: argparse.Namespace, stop: Stop) -> None:
    quick = arguments.quick
    docs = arguments.output or (Path('comparison_output') if quick else evidence.DOCS)
    trials = arguments.trials or (QUICK_TRIALS if quick else TRIALS)
    training = QUICK_TRAINING if quick else TRAINING
    kept: list[Row] = []
    if arguments.only:
        kept = [row for row in evidence.read(NAME, docs) if row['method'] != arguments.only]
    with Workers(arguments.jobs, stop) as workers:
        found = measure(sensors(quick), trials, training, workers, arguments.only)
    rows = evidence.rounded([*kept, *found])
    chosen = best_of_kinds(rows)
    drawn = {
        f'{NAME}_{name}': figures.against_linear(chosen, jumps)
        for name, jumps in (('smooth', False), ('jumps', True))
    }
    evidence.publish(docs, {NAME: rows}, texts(rows), drawn)


def measure(
    chosen: list[Sensor], trials: int, training: int, workers: Workers, only: str | None = None
) -> list[Row]:
    """Tune and judge all methods, or only one, for these sensors; return a line a cell."""
    calls: dict[Any, tuple[Any, ...]] = {
        (sensor, name): (evaluate, sensor, name, training, trials)
        for sensor in chosen
        for name in methods_for(sensor)
        if only in (None, name)
    }
    rows: dict[Any, list[Row]] = {}
    with progress(total=len(calls), unit='tuning', desc='compare') as bar:
        for (sensor, name), (tuned, errors) in workers.results(calls):
            s = sensor
            rows[sensor, name] = [
                Cell(s.plant, d, s.noise, s.rate, s.timing)._asdict()
                | {'method': name, 'training': tuned.training, 'error': error}
                for d, error in zip(s.disturbances, errors, strict=True)
            ]
            bar.update()
    return [row for key in calls for row in rows[key]]
