# SPDX-License-Identifier: Apache-2.0
"""Reproduce all simulations of the paper, check its findings, and go beyond its limits."""

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path

from fhaosmo_ros.core.observer.fuzzy import of_level
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.cli.progress import progress
from fhaosmo_ros.tools.plot.fuzzy import fuzzy_figure
from fhaosmo_ros.tools.plot.fuzzy import Row as FuzzyRow
from matplotlib.figure import Figure
from studies import evidence
from studies.evidence import Row
from studies.harness import output, study
from studies.paper import beyond, cases, figures, findings
from studies.paper.plant_and_observer import SOLVERS

NAME = 'paper'
QUICK_WIDTHS, QUICK_LONG = 6, 200.0
ZOOM = 0.1
"""Seconds that figure sim1 enlarges."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""

    def body(arguments: argparse.Namespace, stop: Stop) -> None:
        with stop.raising():
            _paper(output(arguments, NAME), arguments.quick)

    return run_command(study(NAME, __doc__), argv, body)


def measure(solvers: Sequence[str], tick: Callable[[], object]) -> list[Row]:
    """Return the scores of the paper's observers and of ours by solver."""
    tasks = [(s, name, w) for s in solvers for name in cases.OBSERVERS for w in cases.FREQUENCIES]
    rows = []
    pool = ThreadPoolExecutor(os.cpu_count())  # the integration releases the GIL
    try:
        runs = pool.map(lambda task: findings.run(task[1], task[2], task[0]), tasks)
        for (solver, name, omega), run in zip(tasks, runs, strict=True):
            case = {'solver': solver, 'observer': name, 'omega': omega}
            rows.append(case | cases.score(run))
            tick()
    finally:
        pool.shutdown(cancel_futures=True)  # after a signal nobody needs the runs that wait
    return rows


def _paper(docs: Path, quick: bool) -> None:
    every = QUICK_WIDTHS if quick else 1
    duration = QUICK_LONG if quick else beyond.LONG_DURATION
    joint = len(SOLVERS) * len(cases.OBSERVERS) * len(cases.FREQUENCIES)
    total = joint + len(findings.WIDTHS[::every]) + len(beyond.SAMPLED) + len(beyond.LONG)
    with progress(total=total, unit='part', desc='paper') as bar:

        def each(rows: list[Row]) -> list[Row]:
            bar.update()
            return rows

        simulations = evidence.rounded(measure(list(SOLVERS), bar.update))
        scores = findings.scores_by_solver(simulations)
        solver = findings.choose_solver(scores)
        signs = {w: scores[solver][findings.FINE, w] for w in cases.FREQUENCIES}
        tables = {
            'paper': simulations,
            'paper_half_widths': findings.width_map(signs, solver, every, bar.update),
            'paper_sampled': [
                row for case in beyond.SAMPLED for row in each(beyond.sampled_rows(*case))
            ],
            'paper_long': [
                row for case in beyond.LONG for row in each(beyond.long_rows(*case, duration))
            ],
        }
    evidence.publish(docs, tables, findings.texts(simulations), drawn(solver))


def drawn(solver: str) -> dict[str, Figure]:
    """Return the paper's own four figures, by name."""
    preset = cases.preset().observer
    systems, widths = preset['fuzzy_systems'], preset['fuzzy_widths']
    rows = [  # psi_1, psi_2, psi_3, as in the paper
        FuzzyRow(of_level(systems, i), of_level(widths, i), ('1', '2', '3, 4')[i])
        for i in range(3)
    ]
    runs = {
        name: [findings.run(name, w, solver) for w in cases.FREQUENCIES]
        for name in (findings.FINE, findings.COARSE, findings.FUZZY, findings.ADAPTIVE)
    }
    adaptive = runs.pop(findings.ADAPTIVE)
    first = cases.first_observer(1e-5, solver, cases.DURATION, every=5)
    return {
        'paper_sim1': figures.sim1(first, ZOOM),
        'paper_fuzzysystems': fuzzy_figure(rows),
        'paper_simz': figures.simz(list(runs.items()), cases.FREQUENCIES),
        'paper_simu': figures.simu(adaptive, cases.FREQUENCIES),
    }
