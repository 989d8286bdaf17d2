# SPDX-License-Identifier: Apache-2.0
"""Reproduce all simulations of the paper, check its findings, and go beyond its limits."""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from fhaosmo_ros.core.observer.fuzzy import of_level
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.plot.fuzzy import fuzzy_figure
from fhaosmo_ros.tools.plot.fuzzy import Row as FuzzyRow
from matplotlib.figure import Figure
from studies import evidence
from studies.harness import called, output, study, with_jobs
from studies.paper import beyond, cases, figures, findings
from studies.paper.plant_and_observer import JointRun, SOLVERS

NAME = 'paper'
QUICK_WIDTHS, QUICK_LONG = 6, 200.0
ZOOM = 0.1
"""Seconds that figure sim1 enlarges."""
DRAWN = (findings.FINE, findings.COARSE, findings.FUZZY, findings.ADAPTIVE)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""
    return run_command(with_jobs(study(NAME, __doc__)), argv, _paper)


def _paper(arguments: argparse.Namespace, stop: Stop) -> None:
    docs = output(arguments, NAME)

    def results(calls: Mapping[Any, tuple[Any, ...]]) -> dict[Any, Any]:
        return called(calls, NAME, arguments.jobs, stop)

    every = QUICK_WIDTHS if arguments.quick else 1
    duration = QUICK_LONG if arguments.quick else beyond.LONG_DURATION
    cells = [(s, name, w) for s in SOLVERS for name in cases.OBSERVERS for w in cases.FREQUENCIES]
    found = results(
        {cell: (findings.simulation, *cell) for cell in cells}
        | {('long', *case): (beyond.long_rows, *case, duration) for case in beyond.LONG}
        | {('sampled', *case): (beyond.sampled_rows, *case) for case in beyond.SAMPLED}
    )
    simulations = evidence.rounded(found[cell] for cell in cells)
    scores = findings.scores_by_solver(simulations)
    solver = findings.choose_solver(scores)
    signs = {w: scores[solver][findings.FINE, w] for w in cases.FREQUENCIES}
    runs = {
        (name, w): (cases.simulated, name, w, solver) for name in DRAWN for w in cases.FREQUENCIES
    }
    first = {'sim1': (cases.first_observer, 1e-5, solver, cases.DURATION, 5)}
    widths = findings.WIDTHS[::every]
    maps = {width: (findings.width_rows, width, widths, signs, solver) for width in widths}
    found |= results(first | runs | maps)
    tables = {
        'paper': simulations,
        'paper_half_widths': [row for width in widths for row in found[width]],
        'paper_sampled': [row for case in beyond.SAMPLED for row in found[('sampled', *case)]],
        'paper_long': [row for case in beyond.LONG for row in found[('long', *case)]],
    }
    drawn = draw(found['sim1'], [[found[name, w] for w in cases.FREQUENCIES] for name in DRAWN])
    evidence.publish(docs, tables, findings.texts(simulations), drawn)


def draw(first: JointRun, runs: Sequence[Sequence[JointRun]]) -> dict[str, Figure]:
    """Draw the paper's own four figures from the run of sim1 and those of `DRAWN`."""
    preset = cases.preset().observer
    systems, widths = preset['fuzzy_systems'], preset['fuzzy_widths']
    rows = [  # psi_1, psi_2, psi_3, as in the paper
        FuzzyRow(of_level(systems, i), of_level(widths, i), ('1', '2', '3, 4')[i])
        for i in range(3)
    ]
    *fixed, adaptive = runs
    return {
        'paper_sim1': figures.sim1(first, ZOOM),
        'paper_fuzzysystems': fuzzy_figure(rows),
        'paper_simz': figures.simz(list(zip(DRAWN, fixed, strict=False)), cases.FREQUENCIES),
        'paper_simu': figures.simu(adaptive, cases.FREQUENCIES),
    }
