# SPDX-License-Identifier: Apache-2.0
"""Compare the observer with what people would use instead, all tuned by the same rules."""

import argparse
import os
from pathlib import Path
import time
from typing import Any

from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.cli.processes import Workers
from fhaosmo_ros.tools.cli.progress import progress
from studies import document
from studies.comparison import figures, results, tables
from studies.comparison.cells import Sensor, sensors
from studies.comparison.evaluation import evaluate, METHODS, methods_for, seconds_a_sample
from studies.comparison.methods import steps_bound
from studies.comparison.results import Entry, Results
from studies.comparison.verdicts import verdicts

DOCS = Path(__file__).resolve().parents[2] / 'docs'
FOLDER, RESULTS = 'comparison', 'results.json'
TRIALS, QUICK_TRIALS = 200, 15
TRAINING, QUICK_TRAINING = 4, 1


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""
    return run_command(_parser(), argv, _compare)


def _compare(arguments: argparse.Namespace, stop: Stop) -> None:
    quick = arguments.quick
    output = arguments.output or _default_output(quick)
    trials = arguments.trials or (QUICK_TRIALS if quick else TRIALS)
    training = QUICK_TRAINING if quick else TRAINING
    begin = time.monotonic()
    before = results.load(output / FOLDER / RESULTS) if arguments.only else None
    with document.rewriting(output, FOLDER, 'Comparison') as pages:
        with Workers(arguments.jobs, stop) as workers:
            entries, bounds = tune_all(sensors(quick), trials, training, workers, arguments.only)
        with stop.raising():
            found = Results(entries, sample_times(entries), trials, training, bounds)
            found = before.with_new(found) if before else found
            write(found, pages)
    print(f'\n{tables.verdict_table(verdicts(found.table(list(METHODS))))}\n')
    print(
        f'document: {output / "comparison.md"}, figures: {output / FOLDER} '
        f'({time.monotonic() - begin:.0f} s)'
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='compare', description=__doc__)
    parser.add_argument(
        '--quick',
        action='store_true',
        help='a few cells and trials, for a first look and for tests',
    )
    parser.add_argument(
        '--trials',
        type=_positive,
        metavar='N',
        help=f'trials of each tuning (default: {TRIALS}, {QUICK_TRIALS} with --quick)',
    )
    parser.add_argument(
        '--only',
        choices=list(METHODS),
        metavar='METHOD',
        help='measure this method anew, and take the others from the results that are there',
    )
    parser.add_argument(
        '--jobs',
        type=_positive,
        metavar='N',
        default=os.cpu_count() or 1,
        help='processes (default: one a core)',
    )
    parser.add_argument(
        '--output',
        type=Path,
        metavar='FOLDER',
        help='folder for comparison.md and comparison/ (default: docs of this checkout; '
        'comparison_output with --quick or without a checkout)',
    )
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'expected an integer >= 1, got {text}')
    return value


def _default_output(quick: bool) -> Path:
    return DOCS if not quick and (DOCS / 'comparison.md').is_file() else Path('comparison_output')


def tune_all(
    chosen: list[Sensor],
    trials: int,
    training: int,
    workers: Workers,
    only: str | None = None,
) -> tuple[list[Entry], dict[Sensor, float]]:
    """
    Tune and evaluate all methods for these sensors, and bound the error for step signals.

    With `only`, do it for this method, without the bound.
    """
    tasks = [
        (sensor, name) for sensor in chosen for name in methods_for(sensor) if only in (None, name)
    ]
    known = [sensor for sensor in chosen if only is None and steps_bound.applies(sensor)]
    calls: dict[Any, tuple[Any, ...]] = {
        task: (_tune_and_evaluate, *task, trials, training) for task in tasks
    }
    calls |= {sensor: (steps_bound.bound, sensor) for sensor in known}
    found = {}
    with progress(total=len(calls), unit='tuning', desc='compare') as bar:
        for key, result in workers.results(calls):
            found[key] = result
            bar.update()
    return [found[task] for task in tasks], {sensor: found[sensor] for sensor in known}


def sample_times(entries: list[Entry]) -> dict[str, float]:
    """Return the time (s) that each method takes for a sample of a sensor for all of them."""
    first = next(e.sensor for e in entries if methods_for(e.sensor) == list(METHODS))
    return {
        e.method: seconds_a_sample(e.method, e.tuned, first) for e in entries if e.sensor == first
    }


def _tune_and_evaluate(sensor: Sensor, name: str, trials: int, training: int) -> Entry:
    tuned, scores = evaluate(sensor, name, training, trials)
    return Entry(sensor, name, tuned, scores)


def write(found: Results, pages: document.Pages) -> None:
    """Write document, figures and results."""
    path = pages.folder / RESULTS
    results.save(found, path)
    rounded = results.load(path)  # so that the document is a function of the file
    figures.save_all(rounded, pages.folder)
    pages.write(tables.texts(rounded))
