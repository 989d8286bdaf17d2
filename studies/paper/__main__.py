# SPDX-License-Identifier: Apache-2.0
"""Reproduce all simulations of the paper, check its findings, and go beyond its limits."""

import argparse
from collections.abc import Sequence
import sys

from fhaosmo_ros.core.observer.fuzzy import curve, memberships, of_level
from fhaosmo_ros.tools.plot.figures import COLOURS, envelope, TRUTH
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from studies import evidence
from studies.harness import Floats, Found, Results, run_study
from studies.paper import cases
from studies.paper.cases import FREQUENCIES, LONG, SAMPLED
from studies.paper.plant_and_observer import JointRun, SOLVERS

NAME = 'paper'
NAMES = {
    5: ('NB', 'NS', 'ZR', 'PS', 'PB'),
    7: ('NBB', 'NB', 'NS', 'ZR', 'PS', 'PB', 'PBB'),
}
"""Names of terms by their number."""
QUICK_WIDTHS, QUICK_LONG = 6, 200.0
DRAWN = (cases.FINE, cases.COARSE, cases.FUZZY, cases.ADAPTIVE)
# Estimates that chatter are solid and below; the truth lies on top, dashed so that both are seen.
RED = {'color': COLOURS[0], 'linewidth': 0.9, 'label': 'estimate'}
BLUE = {'color': TRUTH['color'], 'linewidth': 1.7, 'linestyle': (0, (5, 2)), 'label': 'truth'}
TIME = 'time [s]'
ZOOM = 0.1
"""Seconds that figure sim1 enlarges."""


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
    *fixed, adaptive = [[found[name, w] for w in FREQUENCIES] for name in DRAWN]
    drawn = {
        'paper_sim1': sim1(found['sim1']),
        'paper_fuzzysystems': fuzzy_systems(),
        'paper_simz': simz(list(zip(DRAWN, fixed, strict=False))),
        'paper_simu': simu(adaptive),
    }
    return Found(tables, cases.texts(simulations), drawn)


def draw_pair(axes: Axes, t: Floats, truth: Floats, estimate: Floats) -> None:
    """Draw an estimate in red and the truth in blue."""
    axes.plot(*envelope(t, estimate), **RED)
    axes.plot(*envelope(t, truth), **BLUE)
    axes.set_xlim(t[0], t[-1])
    axes.grid(alpha=0.3)


def sim1(run: JointRun) -> Figure:
    """Figure sim1: z1, z2, z3 and eta, and the last `ZOOM` seconds of each."""
    figure = Figure(figsize=(9.0, 8.0), layout='constrained')
    panels = figure.subplots(4, 2, width_ratios=(2, 1))
    eta = run.unknown_input - run.z[:, 2]
    truths = [*run.z.T, eta]
    estimates = [*run.z_hat.T, run.z_tilde[:, 2]]
    labels = ('z₁', 'z₂', 'z₃', 'η')
    late = run.t >= run.t[-1] - ZOOM
    after = 1e3 * (run.t[late] - run.t[late][0])
    for (left, right), label, truth, estimate in zip(
        panels, labels, truths, estimates, strict=True
    ):
        draw_pair(left, run.t, truth, estimate)
        left.set_ylabel(f'{label} [1]')
        right.plot(after, estimate[late], **RED)
        right.plot(after, truth[late], **BLUE)
        right.ticklabel_format(useOffset=False)
        right.margins(x=0.0)
        right.grid(alpha=0.3)
    panels[0, 0].legend(loc='upper left', ncols=2)
    panels[0, 0].set_title('sign, n = 3, step 1e-5 s')
    panels[0, 1].set_title(f'zoom: the last {1e3 * ZOOM:g} ms')
    panels[3, 0].set_xlabel(TIME)
    panels[3, 1].set_xlabel(f'time after {run.t[late][0]:.2f} s [ms]')
    return figure


def simz(rows: Sequence[tuple[str, Sequence[JointRun]]]) -> Figure:
    """Figure simz: d and its estimate, a row an observer, a column a frequency."""
    figure = Figure(figsize=(9.0, 7.0), layout='constrained')
    panels = figure.subplots(len(rows), len(FREQUENCIES), sharex=True)
    for line, (name, runs) in zip(panels, rows, strict=True):
        for axes, run, omega in zip(line, runs, FREQUENCIES, strict=True):
            _unknown_input(axes, run)
            axes.set_title(f'{name}, ω = {omega:g} rad/s', fontsize=10)
    for axes in panels[-1]:
        axes.set_xlabel(TIME)
    panels[0, 0].legend(loc='upper right', ncols=2)
    return figure


def simu(runs: Sequence[JointRun]) -> Figure:
    """Figure simu: d and its estimate on top, gamma below."""
    figure = Figure(figsize=(9.0, 5.4), layout='constrained')
    panels = figure.subplots(2, len(runs), sharex=True)
    for column, (run, omega) in enumerate(zip(runs, FREQUENCIES, strict=True)):
        _unknown_input(panels[0, column], run)
        panels[0, column].set_title(f'fuzzy adaptive, 1e-3 s, ω = {omega:g} rad/s', fontsize=10)
        panels[1, column].plot(*envelope(run.t, run.gamma), color='black', linewidth=1.2)
        panels[1, column].set_ylabel('γ [1]')
        panels[1, column].set_xlabel(TIME)
        panels[1, column].grid(alpha=0.3)
    panels[0, 0].legend(loc='upper right', ncols=2)
    return figure


def _unknown_input(axes: Axes, run: JointRun) -> None:
    estimate = run.z_hat[:, -1]
    draw_pair(axes, run.t, run.unknown_input, estimate)
    axes.set_ylabel('d [1]')
    late = run.t >= 2.0  # the transient may leave the picture
    reach = 1.15 * max(np.abs(estimate[late]).max(), np.abs(run.unknown_input).max())
    axes.set_ylim(-reach, reach)


def fuzzy_systems() -> Figure:
    """Figure fuzzysystems: membership functions of input and output, and the curve, by level."""
    preset, levels = cases.preset().observer, ('1', '2', '3, 4')
    figure = Figure(figsize=(9.0, 0.6 + 2.0 * len(levels)), layout='constrained')
    for k, (left, middle, right) in enumerate(figure.subplots(len(levels), 3)):
        text, width = of_level(preset['fuzzy_systems'], k), of_level(preset['fuzzy_widths'], k)
        half, count = curve(text), int(text.removeprefix('terms '))
        _draw_terms(left, count, width)
        _draw_terms(middle, count, 1.0)
        grid = np.linspace(0.0, width, len(half))
        right.plot([-width, 0, 0, width], [-1, -1, 1, 1], color='#999999', linestyle=':')
        right.plot(np.r_[-grid[::-1], grid], np.r_[-half[::-1], half], color='black')
        right.locator_params(axis='x', nbins=4)
        right.grid(alpha=0.3)
        left.set_xlabel(f'ε of level {levels[k]} [its unit]')
        middle.set_xlabel('ψ [1], before scaling to ±1')
        right.set_xlabel(f'ε of level {levels[k]} [its unit]')
        right.set_ylabel('ψ(ε) [1]')
    figure.suptitle('membership functions of input and output, and the curve (dotted: sign)')
    return figure


def _draw_terms(axes: Axes, count: int, scale: float) -> None:
    """Draw triangles over [-scale, scale], and their names above them."""
    x, peaks = np.linspace(-1.0, 1.0, 1001), np.linspace(-1.0, 1.0, count)
    rows = memberships(x, 'triangle', count)
    for k, (name, peak, row) in enumerate(zip(NAMES[count], peaks, rows, strict=True)):
        style = {'color': COLOURS[k % 2], 'linestyle': '--' if k % 2 else '-'}
        axes.plot(scale * x, row, **style)
        axes.text(scale * peak, 1.05, name, ha='center', fontsize=6)
    axes.set_xlim(-1.05 * scale, 1.05 * scale)
    axes.set_ylim(0.0, 1.18)
    axes.set_ylabel('membership [1]')
    axes.locator_params(axis='x', nbins=4)


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
