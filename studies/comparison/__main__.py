# SPDX-License-Identifier: Apache-2.0
"""Compare the observer with what people would use instead, all tuned by the same rules."""

import argparse
import sys

from studies import evidence
from studies.comparison.cells import sensors
from studies.comparison.evaluation import evaluate, methods_for
from studies.comparison.results import best_of_kinds, Cell, draw, texts
from studies.harness import Found, Results, run_study

NAME = 'comparison'
FULL, QUICK = (4, 200), (1, 15)
"""Recordings that tune a method, and trials."""


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return a line for each cell and method."""
    quick = arguments.quick
    training, trials = QUICK if quick else FULL
    found = results({
        (sensor, name): (evaluate, sensor, name, training, trials)
        for sensor in sensors(quick)
        for name in methods_for(sensor)
    })  # fmt: skip
    rows = evidence.rounded(
        Cell(s.plant, d, s.noise, s.rate, s.timing)._asdict()
        | {'method': name, 'training': tuned.training, 'error': error}
        for (s, name), (tuned, errors) in found.items()
        for d, error in zip(s.disturbances, errors, strict=True)
    )
    chosen = best_of_kinds(rows)
    drawn = {'comparison_smooth': draw(chosen, False), 'comparison_jumps': draw(chosen, True)}
    return Found({NAME: rows}, texts(rows), drawn)


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
