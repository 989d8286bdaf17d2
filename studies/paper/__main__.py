# SPDX-License-Identifier: Apache-2.0
"""Reproduce all simulations of the paper, check its findings, and go beyond its limits."""

import argparse
from collections.abc import Sequence
import sys

from fhaosmo_ros.tools.plot.figures import COLOURS, envelope, TRUTH
from matplotlib.figure import Figure
import numpy as np
from studies import evidence
from studies.harness import Found, Results, run_study
from studies.paper import cases
from studies.paper.cases import FREQUENCIES, LONG, SAMPLED
from studies.paper.plant_and_observer import JointRun, SOLVERS

NAME = 'paper'
QUICK_WIDTHS, QUICK_LONG = 6, 200.0
DRAWN = (cases.FINE, cases.COARSE, cases.FUZZY, cases.ADAPTIVE)
# Estimates that chatter are solid and below; the truth lies on top, dashed so that both are seen.
RED = {'color': COLOURS[0], 'linewidth': 0.9, 'label': 'estimate'}
BLUE = {'color': TRUTH['color'], 'linewidth': 1.7, 'linestyle': (0, (5, 2)), 'label': 'truth'}
ZOOM = 0.1  # seconds that figure sim1 enlarges


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return all tables: first the simulations, because the half-widths take scores of sign."""
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
    scores = cases.scores_of(simulations, cases.SOLVER)
    signs = {key: score for key, score in scores.items() if key[0].startswith('sign')}
    found |= results(
        {'sim1': (cases.first_observer,)}
        | {(name, w): (cases.simulated, name, w) for name in DRAWN for w in FREQUENCIES}
        | {width: (cases.width_rows, width, widths, signs) for width in widths}
    )
    tables = {
        'paper': simulations,
        'paper_half_widths': [row for width in widths for row in found[width]],
        'paper_sampled': [row for case in SAMPLED for row in found[('sampled', *case)]],
        'paper_long': [row for case in LONG for row in found[('long', *case)]],
    }
    *fixed, adaptive = ([(name, w, found[name, w]) for w in FREQUENCIES] for name in DRAWN)
    drawn = {
        'paper_sim1': sim1(found['sim1']), 'paper_simz': unknown_inputs(fixed),
        'paper_simu': unknown_inputs([adaptive], gamma=True),
    }  # fmt: skip
    return Found(tables, cases.texts(simulations), drawn)


def sim1(run: JointRun) -> Figure:
    """Figure sim1: z1, z2, z3 and eta, and the last `ZOOM` seconds of each."""
    figure = Figure(figsize=(9.0, 8.0), layout='constrained')
    panels = figure.subplots(4, 2, width_ratios=(2, 1))
    truths = [*run.z.T, run.unknown_input - run.z[:, 2]]
    estimates = [*run.z_hat.T, run.z_tilde[:, 2]]
    late = run.t >= run.t[-1] - ZOOM
    after = 1e3 * (run.t[late] - run.t[late][0])
    for (left, right), label, truth, estimate in zip(
        panels, ('z₁', 'z₂', 'z₃', 'η'), truths, estimates, strict=True
    ):
        for x, style in ((estimate, RED), (truth, BLUE)):
            left.plot(*envelope(run.t, x), **style)
            right.plot(after, x[late], **style)
        left.set(ylabel=f'{label} [1]', xlim=(run.t[0], run.t[-1]))
        right.ticklabel_format(useOffset=False)
        right.margins(x=0.0)
    panels[0, 0].legend(loc='upper left', ncols=2)
    panels[0, 0].set_title('sign, n = 3, step 1e-5 s')
    panels[0, 1].set_title(f'zoom: the last {1e3 * ZOOM:g} ms')
    panels[3, 0].set_xlabel('time [s]')
    panels[3, 1].set_xlabel(f'time after {run.t[late][0]:.2f} s [ms]')
    for axes in panels.flat:
        axes.grid(alpha=0.3)
    return figure


def unknown_inputs(
    rows: Sequence[Sequence[tuple[str, float, JointRun]]], gamma: bool = False
) -> Figure:
    """Figures simz and simu: d and its estimate, a column a frequency; gamma below."""
    count = len(rows) + gamma
    figure = Figure(figsize=(9.0, 0.7 + 2.1 * count), layout='constrained')
    panels = figure.subplots(count, len(FREQUENCIES), sharex=True)
    for line, runs in zip(panels, rows, strict=False):
        for axes, (name, omega, run) in zip(line, runs, strict=True):
            estimate, late = run.z_hat[:, -1], run.t >= 2.0  # the transient may leave the picture
            axes.plot(*envelope(run.t, estimate), **RED)
            axes.plot(*envelope(run.t, run.unknown_input), **BLUE)
            reach = 1.15 * max(np.abs(estimate[late]).max(), np.abs(run.unknown_input).max())
            axes.set(ylabel='d [1]', ylim=(-reach, reach), xlim=(run.t[0], run.t[-1]))
            axes.set_title(f'{name}, ω = {omega:g} rad/s', fontsize=10)
    if gamma:
        for axes, (_, _, run) in zip(panels[-1], rows[-1], strict=True):
            axes.plot(*envelope(run.t, run.gamma), color='black', linewidth=1.2)
            axes.set_ylabel('γ [1]')
    for axes in panels.flat:
        axes.grid(alpha=0.3)
    for axes in panels[-1]:
        axes.set_xlabel('time [s]')
    panels[0, 0].legend(loc='upper right', ncols=2)
    return figure


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
