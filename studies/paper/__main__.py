# SPDX-License-Identifier: Apache-2.0
"""Reproduce all simulations of the paper, check its findings, and go beyond its limits."""

import argparse
from collections.abc import Sequence
import sys

from matplotlib.figure import Figure
from studies import evidence
from studies.harness import Found, Results, run_study
from studies.paper import cases, figures
from studies.paper.cases import FREQUENCIES, LONG, SAMPLED
from studies.paper.plant_and_observer import JointRun, SOLVERS

NAME = 'paper'
QUICK_WIDTHS, QUICK_LONG = 6, 200.0
DRAWN = (cases.FINE, cases.COARSE, cases.FUZZY, cases.ADAPTIVE)


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return all tables: first the simulations, whose best solver the half-widths take."""
    quick = arguments.quick
    widths = cases.WIDTHS[:: QUICK_WIDTHS if quick else 1]
    duration = QUICK_LONG if quick else cases.LONG_DURATION
    cells = [(s, name, w) for s in SOLVERS for name in cases.OBSERVERS for w in FREQUENCIES]
    found = results(
        {cell: (cases.simulation, *cell) for cell in cells}
        | {('long', *case): (cases.long_rows, *case, duration) for case in LONG}
        | {('sampled', *case): (cases.sampled_rows, *case) for case in SAMPLED}
    )
    simulations = evidence.rounded(found[cell] for cell in cells)
    scores = cases.scores_by_solver(simulations)
    solver = cases.choose_solver(scores)
    signs = {w: scores[solver][cases.FINE, w] for w in FREQUENCIES}
    found |= results(
        {'sim1': (cases.first_observer, solver)}
        | {(name, w): (cases.simulated, name, w, solver) for name in DRAWN for w in FREQUENCIES}
        | {width: (cases.width_rows, width, widths, signs, solver) for width in widths}
    )
    tables = {
        'paper': simulations,
        'paper_half_widths': [row for width in widths for row in found[width]],
        'paper_sampled': [row for case in SAMPLED for row in found[('sampled', *case)]],
        'paper_long': [row for case in LONG for row in found[('long', *case)]],
    }
    drawn = draw(found['sim1'], [[found[name, w] for w in FREQUENCIES] for name in DRAWN])
    return Found(tables, cases.texts(simulations), drawn)


def draw(first: JointRun, runs: Sequence[Sequence[JointRun]]) -> dict[str, Figure]:
    """Draw the paper's own four figures from the run of sim1 and those of `DRAWN`."""
    *fixed, adaptive = runs
    return {
        'paper_sim1': figures.sim1(first),
        'paper_fuzzysystems': figures.fuzzy_systems(),
        'paper_simz': figures.simz(list(zip(DRAWN, fixed, strict=False)), FREQUENCIES),
        'paper_simu': figures.simu(adaptive, FREQUENCIES),
    }


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
