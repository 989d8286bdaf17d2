# SPDX-License-Identifier: Apache-2.0
"""The comparison's figures: error against noise, ratios against the bars, and estimates of d."""

from math import log10
from pathlib import Path

from fhaosmo_ros.tools.plot.figures import envelope
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from studies.comparison.cells import NOISES, PLANTS, Sensor
from studies.comparison.evaluation import estimates, METHODS
from studies.comparison.methods.linear import LINEAR_LIMIT
from studies.comparison.methods.ours import OURS
from studies.comparison.results import Cell, Results, Table
from studies.comparison.verdicts import KALMAN, verdicts

BLACK, BLUE, ORANGE, GREEN, SKY, PINK, YELLOW, GREY = (
    '#000000', '#0072B2', '#D55E00', '#009E73', '#56B4E9', '#CC79A7', '#E69F00', '#999999',
)  # fmt: skip
"""Okabe-Ito, and a grey; each method also has a marker and dashes of its own."""
STYLES: dict[str, tuple[str, str, str]] = {
    'Kalman': (BLUE, 'o', '-'),
    'Kalman, ramp': (SKY, 'D', '--'),
    'Kalman, decaying': (BLUE, 'h', ':'),
    LINEAR_LIMIT: (BLACK, 'd', '-.'),
    'ESO': (GREEN, '^', '-.'),
    'Luenberger': (GREEN, 'v', ':'),
    'Levant, explicit': (PINK, 's', '--'),
    'Levant, implicit': (PINK, 'P', '-'),
    'paper: sign': (GREY, 'x', ':'),
    'paper: fuzzy': (GREY, '+', '-.'),
    'paper: adaptive': (GREY, '1', '--'),
    OURS: (ORANGE, '*', '-'),
}
TICKS = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 8.0)
SHOWN = (('paper', 'mix'), ('paper', 'steps'), ('pendulum', 'steps'), ('motor', 'steps'))
"""Plants and disturbances whose estimates are drawn."""
FLOOR, CEILING = 1e-7, 10.0
"""Limits of the error's axis."""

rcParams['svg.hashsalt'] = 'fhaosmo_ros'  # the same figure gives the same file


def save_all(results: Results, folder: Path) -> None:
    """Write all figures as SVG and PNG, without the date of the day."""
    table = results.table(list(METHODS))
    drawn = {'noise': noise(table), 'ratios': ratios(table), 'estimates': time_series(results)}
    for name, figure in drawn.items():
        figure.savefig(folder / f'{name}.svg', metadata={'Date': None})
        figure.savefig(folder / f'{name}.png', dpi=110)


def noise(table: Table) -> Figure:
    """Draw the error of d against the noise: a panel a plant, disturbance and rate."""
    even = [cell for cell in table if cell.sensor.timing == 'even']
    names = list(dict.fromkeys((c.sensor.plant, c.disturbance) for c in even))
    rates = sorted({c.sensor.rate for c in even}, reverse=True)
    # The paper's plant, then the others; within each, a row a rate.
    blocks = [[n for n in names if (n[0] == 'paper') == first] for first in (True, False)]
    rows = [(rate, block) for block in blocks if block for rate in rates]
    columns = max(len(block) for _, block in rows)
    size = (2.1 * max(columns, 4) + 0.8, 2.5 * len(rows) + 1.2)
    figure = Figure(figsize=size, layout='constrained')
    panels = figure.subplots(len(rows), columns, sharex=True, sharey=True, squeeze=False)
    places = {level: i for i, level in enumerate(NOISES)}
    for axes_row, (rate, block) in zip(panels, rows, strict=True):
        for axes, (plant, disturbance) in zip(axes_row, block, strict=False):
            cells = [
                c
                for c in even
                if (c.sensor.plant, c.disturbance, c.sensor.rate) == (plant, disturbance, rate)
            ]
            _errors(axes, [(places[c.sensor.noise], table[c]) for c in cells])
            axes.set_title(f'{PLANTS[plant].text}, {disturbance}', fontsize=9)
        for axes in axes_row[len(block) :]:
            axes.set_visible(False)
        axes_row[0].set_ylabel(f'{rate:g} Hz\nRMS error of d / RMS of d')
    panels[0, 0].set_ylim(FLOOR, CEILING)
    ticks = ['0', *(f'$10^{{{round(log10(x))}}}$' for x in NOISES[1:])]
    panels[0, 0].set_xticks(range(len(NOISES)), ticks)
    for axes in panels.flat:
        axes.tick_params(labelbottom=True)
    figure.supxlabel("standard deviation of the noise on y (pendulum, motor: over y's amplitude)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=5, fontsize=9)
    return figure


def _errors(axes: Axes, cells: list[tuple[int, dict]]) -> None:
    for name, (colour, marker, dashes) in STYLES.items():
        pairs = [(at, scores[name].d) for at, scores in cells if name in scores]
        axes.plot(
            [at for at, _ in pairs],
            [min(d, 2.0 * CEILING) for _, d in pairs],
            color=colour,
            marker=marker,
            linestyle=dashes,
            label=name,
            markersize=9 if name == OURS else 5,
            linewidth=1.8 if name == OURS else 1.0,
            zorder=3 if name == OURS else 2,
            fillstyle='full' if name == OURS else 'none',
        )
    axes.axhline(1.0, color=BLACK, linewidth=0.8)
    axes.set_yscale('log')
    axes.grid(alpha=0.3)


def ratios(table: Table) -> Figure:
    """Draw our error over the rival's for each bar, cell by cell."""
    judged = [v for v in verdicts(table) if v.ratios]
    heights = [len(v.ratios) for v in judged]
    figure = Figure(figsize=(8.0, 0.21 * sum(heights) + 1.1 * len(judged)), layout='constrained')
    panels = figure.subplots(len(judged), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axes, v in zip(panels, judged, strict=True):
        values = list(v.ratios.values())
        reached = [ratio <= v.bar.limit for ratio in values]
        for good, colour, marker, label in (
            (True, BLUE, 'o', 'reached'),
            (False, ORANGE, 'X', 'not reached'),
        ):
            places = [i for i, ok in enumerate(reached) if ok == good]
            axes.plot(
                [values[i] for i in places],
                places,
                color=colour,
                marker=marker,
                linestyle='none',
                label=label,
            )
        axes.axvline(v.bar.limit, color=BLACK, linewidth=1.0)
        axes.set_xscale('log')
        low, high = min([*values, v.bar.limit]), max([*values, v.bar.limit])
        axes.set_xlim(low / 1.1, high * 1.1)
        axes.set_yticks(range(len(values)), [_name(cell) for cell in v.ratios], fontsize=7)
        axes.invert_yaxis()
        axes.grid(alpha=0.3)
        if high / low < 10.0:
            axes.xaxis.set_major_locator(LogLocator(subs=TICKS))
        axes.xaxis.set_major_formatter('{x:g}')
        axes.xaxis.set_minor_formatter('')
        axes.set_title(v.bar.claim, fontsize=9, loc='right')
        axes.legend(fontsize=8)
    panels[-1].set_xlabel("our RMS error of d over the rival's")
    return figure


def _name(cell: Cell) -> str:
    s = cell.sensor
    timing = '' if s.timing == 'even' else f', {s.timing}'
    return f'{cell.plant}, {cell.disturbance}, {s.rate:g} Hz{timing}, noise {s.noise:g}'


def time_series(results: Results) -> Figure:
    """Draw d and its estimates on a held-out recording of each of some cells."""
    table = results.table(list(METHODS))
    noisy = [c for c in table if c.sensor.noise == 1e-3 and c.sensor.timing == 'even']
    first = {(c.sensor.plant, c.disturbance): c for c in reversed(noisy)}
    chosen = [first[name] for name in SHOWN if name in first]
    figure = Figure(figsize=(9.0, 2.2 * len(chosen) + 0.8), layout='constrained')
    panels = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    for axes, cell in zip(panels, chosen, strict=True):
        _estimates(axes, results, cell.sensor, cell.disturbance)
        axes.set_title(_name(cell), fontsize=9)
        axes.set_ylabel('d')
    panels[0].legend(ncols=3, fontsize=8, loc='upper right')
    panels[-1].set_xlabel('time [s]')
    return figure


def _estimates(axes: Axes, results: Results, sensor: Sensor, disturbance: str) -> None:
    recording = sensor.held_out(disturbance, 1)[0]
    late = recording.t >= 4.0
    t = recording.t[late]
    axes.plot(*envelope(t, recording.d[late]), color=BLACK, linewidth=1.6, label='truth')
    for name, colour, dashes in ((KALMAN, BLUE, '--'), (OURS, ORANGE, '-')):
        entry = results.find(sensor, name)
        if entry is not None:
            found = estimates(METHODS[name], sensor.setting(), entry.tuned, [recording])[0]
            curve = envelope(t, found.d[late])
            axes.plot(*curve, color=colour, linestyle=dashes, linewidth=1.0, label=name)
    size = float(abs(recording.d).max())
    axes.set_ylim(-1.6 * size, 1.6 * size)
    axes.grid(alpha=0.3)
