# SPDX-License-Identifier: Apache-2.0
"""The figures of the paper: drawn on Axes from the shared palette, written as SVG and PNG."""

from collections.abc import Sequence
from pathlib import Path

from fhaosmo_ros.tools.plot.figures import COLOURS, envelope, TRUTH
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from studies.paper.beyond import LongRun, Row
from studies.paper.findings import WidthMap
from studies.paper.plant_and_observer import JointRun

Floats = NDArray[np.float64]
# Estimates that chatter are solid and below; the truth lies on top, dashed so that both are seen.
RED = {'color': COLOURS[0], 'linewidth': 0.9, 'label': 'estimate'}
BLUE = {'color': TRUTH['color'], 'linewidth': 1.7, 'linestyle': (0, (5, 2)), 'label': 'truth'}
TIME = 'time [s]'
STYLES = {
    'sign': ('#000000', 'o', '-'),
    'fuzzy': ('#0072B2', 's', '--'),
    'fuzzy adaptive': ('#D55E00', '^', ':'),
    'Levant sign': ('#009E73', 'D', '-'),
    'Levant fuzzy': ('#CC79A7', 'v', '--'),
}
LAW_COLOURS = {"the paper's": '#D55E00', 'default': '#0072B2'}
PROTECTION_STYLES = (
    ('#D55E00', '-', 2.6),
    ('#000000', '--', 1.2),
    ('#CC79A7', '-.', 1.6),
    ('#009E73', ':', 1.8),
    ('#0072B2', '-', 1.4),
)

rcParams['svg.hashsalt'] = 'fhaosmo_ros'  # the same figure gives the same file


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as SVG and PNG, without a date: the same figure gives the same file."""
    figure.savefig(folder / f'{name}.svg', metadata={'Date': None})
    figure.set_layout_engine(None)  # is done, and costs more time than the drawing
    figure.savefig(folder / f'{name}.png', dpi=130)


def draw_pair(axes: Axes, t: Floats, truth: Floats, estimate: Floats) -> None:
    """Draw an estimate in red and the truth in blue."""
    axes.plot(*envelope(t, estimate), **RED)
    axes.plot(*envelope(t, truth), **BLUE)
    axes.set_xlim(t[0], t[-1])
    axes.grid(alpha=0.3)


def sim1(run: JointRun, zoom: float) -> Figure:
    """Figure sim1: z1, z2, z3 and eta, and the last `zoom` seconds of each."""
    figure = Figure(figsize=(9.0, 8.0), layout='constrained')
    panels = figure.subplots(4, 2, width_ratios=(2, 1))
    eta = run.unknown_input - run.z[:, 2]
    truths = [*run.z.T, eta]
    estimates = [*run.z_hat.T, run.z_tilde[:, 2]]
    labels = ('z₁', 'z₂', 'z₃', 'η')
    late = run.t >= run.t[-1] - zoom
    for row, (label, truth, estimate) in enumerate(zip(labels, truths, estimates, strict=True)):
        left, right = panels[row]
        draw_pair(left, run.t, truth, estimate)
        left.set_ylabel(f'{label} [1]')
        right.plot(1e3 * (run.t[late] - run.t[late][0]), estimate[late], **RED)
        right.plot(1e3 * (run.t[late] - run.t[late][0]), truth[late], **BLUE)
        right.ticklabel_format(useOffset=False)
        right.margins(x=0.0)
        right.grid(alpha=0.3)
    panels[0, 0].legend(loc='upper left', ncols=2)
    panels[0, 0].set_title('sign, n = 3, step 1e-5 s')
    panels[0, 1].set_title(f'zoom: the last {1e3 * zoom:g} ms')
    panels[3, 0].set_xlabel(TIME)
    panels[3, 1].set_xlabel(f'time after {run.t[late][0]:.2f} s [ms]')
    return figure


def simz(rows: Sequence[tuple[str, Sequence[JointRun]]], frequencies: Sequence[float]) -> Figure:
    """Figure simz: d and its estimate, a row an observer, a column a frequency."""
    figure = Figure(figsize=(9.0, 7.0), layout='constrained')
    panels = figure.subplots(len(rows), len(frequencies), sharex=True)
    for line, (name, runs) in zip(panels, rows, strict=True):
        for axes, run, omega in zip(line, runs, frequencies, strict=True):
            _unknown_input(axes, run)
            axes.set_title(f'{name}, ω = {omega:g} rad/s', fontsize=10)
    for axes in panels[-1]:
        axes.set_xlabel(TIME)
    panels[0, 0].legend(loc='upper right', ncols=2)
    return figure


def simu(runs: Sequence[JointRun], frequencies: Sequence[float]) -> Figure:
    """Figure simu: d and its estimate on top, gamma below."""
    figure = Figure(figsize=(9.0, 5.4), layout='constrained')
    panels = figure.subplots(2, len(runs), sharex=True)
    for column, (run, omega) in enumerate(zip(runs, frequencies, strict=True)):
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


def half_widths(widths: WidthMap, preset: Sequence[float]) -> Figure:
    """Draw where F1c, F2 and F3 hold over the half-widths."""
    figure = Figure(figsize=(6.8, 6.8), layout='constrained')
    axes = figure.subplots()
    count = len(widths.widths)
    axes.imshow(
        widths.holds.sum(axis=0),
        origin='lower',
        vmin=0,
        vmax=3,
        cmap=ListedColormap(['#ffffff', '#e4e4e4', '#b8cfe0', '#F0E442']),
    )
    for i in range(count):
        for j in range(count):
            text = ''.join(str(k + 1) for k in range(3) if widths.holds[k, i, j])
            bold = 'bold' if widths.region[i, j] else 'normal'
            axes.text(j, i, text, ha='center', va='center', fontsize=6.5, weight=bold)
    where = [int(np.argmin(np.abs(widths.widths - w))) for w in preset[:2]]
    if np.allclose(widths.widths[where], preset[:2]):
        axes.plot(
            where[1],
            where[0],
            's',
            markersize=19,
            fillstyle='none',
            color='#D55E00',
            markeredgewidth=2.0,
        )
    ticks = [f'{w:g}' for w in widths.widths]
    axes.set_xticks(range(count), ticks, rotation=60, fontsize=8)
    axes.set_yticks(range(count), ticks, fontsize=8)
    axes.set_xlabel('half-width of levels 2, 3, 4 [unit of z₂, z₃, d]')
    axes.set_ylabel('half-width of level 1 [unit of y]')
    axes.set_title('1: F1c holds, 2: F2, 3: F3; yellow: all three; red: the preset', fontsize=10)
    return figure


def long_runs(runs: Sequence[LongRun]) -> Figure:
    """Draw gamma and the RMS error of d over a long adaptation, relative to gamma = 1/2."""
    cells = list(dict.fromkeys((r.noise, r.omega) for r in runs))
    figure = Figure(figsize=(10.0, 5.4), layout='constrained')
    panels = figure.subplots(2, len(cells), sharex=True, sharey='row', squeeze=False)
    for column, (noise, omega) in zip(panels.T, cells, strict=True):
        for run in runs:
            if (run.noise, run.omega) != (noise, omega):
                continue
            style = {
                'color': LAW_COLOURS[run.law],
                'linestyle': '-' if run.scheme == 'explicit' else '--',
                'label': f'{run.law} law, {run.scheme}',
                'linewidth': 1.3 if run.law == 'default' else 3.0,
            }
            column[0].plot(run.t, run.gamma, **style)
            column[1].plot(run.t, run.rms_d / run.fixed, **style)
        column[0].set_title(f'ω = {omega:g} rad/s, noise {noise:g}', fontsize=10)
        column[1].axhline(1.0, color='#999999', linewidth=1.0)
        column[1].set_xlabel(TIME)
        for axes in column:
            axes.grid(alpha=0.3)
    panels[0, 0].set_ylabel('γ [1]')
    panels[1, 0].set_ylabel('RMS error of d in 100 s,\nover that of γ = 1/2 [1]')
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc='outside lower center', ncols=4)
    return figure


def protections(runs_of_all: Sequence[LongRun]) -> Figure:
    """Draw gamma and the RMS error of d with each protection by itself, a column a cell."""
    cells: dict[tuple[float, float], list[LongRun]] = {}
    for run in runs_of_all:
        cells.setdefault((run.omega, run.noise), []).append(run)
    figure = Figure(figsize=(10.0, 6.0), layout='constrained')
    panels = figure.subplots(2, len(cells), sharex=True, squeeze=False)
    for (top, bottom), runs in zip(panels.T, cells.values(), strict=True):
        for run, (colour, style, width) in zip(runs, PROTECTION_STYLES, strict=True):
            line = {'color': colour, 'linestyle': style, 'linewidth': width}
            line['label'] = run.law.replace("paper's", "paper's law")
            top.plot(run.t, run.gamma, **line)
            bottom.plot(run.t, run.rms_d, **line)
        bottom.axhline(runs[0].fixed, color='#999999', linewidth=1.0)
        top.axhline(0.5, color='#999999', linewidth=1.0, label='γ = 1/2, not adapted')
        top.set_title(f'ω = {runs[0].omega:g} rad/s, noise {runs[0].noise:g}', fontsize=10)
        bottom.set_xlabel(TIME)
        for axes in (top, bottom):
            axes.grid(alpha=0.3)
    panels[0, 0].set_ylabel('γ [1]')
    panels[1, 0].set_ylabel('RMS error of d in 20 s [1]')
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc='outside lower center', ncols=3)
    return figure


def noise(rows: Sequence[Row]) -> Figure:
    """Draw the RMS error of d over the noise on y."""
    figure = Figure(figsize=(9.0, 4.4), layout='constrained')
    panels = figure.subplots(1, 2, sharey=True)
    for axes, scheme in zip(panels, ('explicit', 'implicit'), strict=True):
        for name, (colour, marker, line) in STYLES.items():
            chosen = [r for r in rows if (r.name, r.scheme) == (name, scheme)]
            axes.loglog(
                [r.noise for r in chosen],
                [r.score['rms_d'] for r in chosen],
                marker=marker,
                linestyle=line,
                color=colour,
                label=name,
            )
        axes.axhline(0.1 / np.sqrt(2.0), color='#999999', linewidth=1.0, label='RMS of d itself')
        axes.set_title(f'{scheme}, step 1e-3 s', fontsize=10)
        axes.set_xlabel('standard deviation of the noise on y [unit of y]')
        axes.grid(alpha=0.3)
    panels[0].set_ylabel('RMS error of d [1]')
    figure.legend(*panels[0].get_legend_handles_labels(), loc='outside lower center', ncols=3)
    return figure
