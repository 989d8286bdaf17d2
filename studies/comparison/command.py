# SPDX-License-Identifier: Apache-2.0
"""Compare the observer with what people would use instead, all tuned by the same rules."""

import argparse
from typing import Any

from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from studies import evidence
from studies.comparison.cells import sensors
from studies.comparison.evaluation import evaluate, METHODS, methods_for
from studies.comparison.results import best_of_kinds, Cell, draw, texts
from studies.evidence import Row
from studies.harness import called, output, positive, study, with_jobs

NAME = 'comparison'
TRIALS, QUICK_TRIALS = 200, 15
TRAINING, QUICK_TRAINING = 4, 1


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""
    parser = with_jobs(study(NAME, __doc__))
    parser.add_argument('--trials', type=positive, metavar='N', help='trials of each tuning')
    parser.add_argument(
        '--only', choices=list(METHODS), metavar='METHOD',
        help='measure this method anew, and take the others from the results that are there',
    )  # fmt: skip
    return run_command(parser, argv, _compare)


def _compare(arguments: argparse.Namespace, stop: Stop) -> None:
    docs = output(arguments, NAME)
    trials = arguments.trials or (QUICK_TRIALS if arguments.quick else TRIALS)
    training = QUICK_TRAINING if arguments.quick else TRAINING
    kept: list[Row] = []
    if arguments.only:
        kept = [row for row in evidence.read(NAME, docs) if row['method'] != arguments.only]
    calls: dict[Any, tuple[Any, ...]] = {
        (sensor, name): (evaluate, sensor, name, training, trials)
        for sensor in sensors(arguments.quick)
        for name in methods_for(sensor)
        if arguments.only in (None, name)
    }
    found = called(calls, NAME, arguments.jobs, stop)
    new = [
        Cell(s.plant, d, s.noise, s.rate, s.timing)._asdict()
        | {'method': name, 'training': found[s, name][0].training, 'error': error}
        for s, name in calls
        for d, error in zip(s.disturbances, found[s, name][1], strict=True)
    ]
    rows = evidence.rounded([*kept, *new])
    chosen = best_of_kinds(rows)
    drawn = {
        f'{NAME}_{name}': draw(chosen, jumps)
        for name, jumps in (('smooth', False), ('jumps', True))
    }
    evidence.publish(docs, {NAME: rows}, texts(rows), drawn)
