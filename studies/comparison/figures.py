# SPDX-License-Identifier: Apache-2.0
"""The comparison's figures: cost, errors beside the linear filter's, and estimates of d."""

from collections.abc import Iterable
from pathlib import Path

from fhaosmo_ros.tools.plot.figures import envelope
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from studies.comparison.cells import PLANTS
from studies.comparison.evaluation import estimates, METHODS
from studies.comparison.methods.method import (
    KINDS,
    LINEAR,
    OURS,
    PAPER,
    ROBUST,
    SELF_TUNING,
    SLIDING,
    USUAL,
)
from studies.comparison.results import Cell, Chosen, Results
from studies.comparison.scores import mean
from studies.comparison.tables import number, ratios, RIVALS, sampling

BLACK = '#000000'
STYLES = {
    LINEAR: ('#0072B2', 'o', 26), USUAL: (BLACK, 'o', 22), ROBUST: ('#56B4E9', '^', 26),
    SLIDING: ('#CC79A7', 'D', 20), PAPER: ('#999999', 'x', 26), OURS: ('#009E73', 's', 24),
    SELF_TUNING: ('#D55E00', '*', 90),
}  # fmt: skip
"""Okabe-Ito, and a grey; marker and its area."""
FLOOR, CEILING, EDGE = 0.3, 10.0, 35.0
"""Smallest and largest ratio that is drawn, and where the linear filter's error stands."""
TICKS = (0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
SHOWN = (('paper', 'mix'), ('pendulum', 'noise'), ('motor', 'sawtooth'))
"""Plants and disturbances whose estimates are drawn."""


def save_all(results: Results, folder: Path) -> None:
    """Write all figures."""
    chosen = results.best_of_kinds()
    drawn = {
        'cost': cost(results),
        'smooth': against_linear(chosen, jumps=False),
        'jumps': against_linear(chosen, jumps=True),
        'estimates': time_series(results),
    }
    for name, figure in drawn.items():
        figure.savefig(folder / f'{name}.png', dpi=110)


def cost(results: Results) -> Figure:
    """Draw the time that a sample takes."""
    names = [name for name in METHODS if name in results.seconds]
    figure = Figure(figsize=(8.0, 0.27 * len(names) + 1.0), layout='constrained')
    axes = figure.subplots()
    for kind in KINDS:
        rows = [i for i, name in enumerate(names) if METHODS[name].kind == kind]
        times = [1e6 * results.seconds[names[i]] for i in rows]
        bars = axes.barh(rows, times, color=STYLES[kind][0], label=kind)
        axes.bar_label(bars, [f'{time:.2g}' for time in times], padding=3, fontsize=8)
    axes.set(xscale='log', xlabel='time a sample [µs]; a period at 1 kHz has 1000 µs')
    axes.set_xlim(1e4 * min(results.seconds.values()) * 5.0, 1e3)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.invert_yaxis()
    axes.grid(axis='x', alpha=0.3)
    axes.legend(fontsize=8, loc='lower right')
    return figure


def against_linear(chosen: Chosen, *, jumps: bool) -> Figure:
    """Draw each kind's error over that of the best linear filter: a panel a plant."""
    about = [c for c in chosen if c.kind.jumps == jumps]
    plants = [p for p in PLANTS if any(c.sensor.plant == p for c in about)]
    rows = list(dict.fromkeys(_row(c) for c in sorted(about, key=_order)))
    size = (11.0, 0.36 * len(rows) + 1.6)
    figure = Figure(figsize=size, layout='constrained')
    panels = figure.subplots(1, len(plants), sharey=True, squeeze=False)[0]
    for plant, axes in zip(plants, panels, strict=True):
        for at, row in enumerate(rows):
            cells = {c for c in about if c.sensor.plant == plant and _row(c) == row}
            if cells:
                error = number(mean(chosen[c][LINEAR][1].d for c in cells))
                axes.text(EDGE, at, error, fontsize=8, va='center', ha='right')
            for kind in RIVALS if cells else ():
                found = ratios(chosen, kind, cells.__contains__)
                if found:
                    colour, marker, area = STYLES[kind]
                    place = min(max(mean(found.values()), FLOOR), CEILING)
                    front = 4 if kind == SELF_TUNING else 3
                    axes.scatter(place, at, area, colour, marker=marker, zorder=front)
        axes.axvline(1.0, color=BLACK, linewidth=0.8)
        axes.set(xscale='log', xlim=(0.9 * FLOOR, 1.1 * EDGE), title=PLANTS[plant].text)
        axes.set_yticks(range(len(rows)), rows)
        axes.set_xticks(TICKS, [f'{x:g}' for x in TICKS])
        axes.xaxis.set_minor_formatter('')
        axes.grid(alpha=0.3)
    panels[0].invert_yaxis()
    figure.supxlabel(
        f'd {"with" if jumps else "without"} jumps: error of d over that of the best linear '
        f"filter ({FLOOR:g}, {CEILING:g}: that or beyond); at the right edge the linear filter's "
        'own error over the RMS of d',
        fontsize='medium',
    )
    _legend(figure, RIVALS)
    return figure


def _legend(figure: Figure, kinds: Iterable[str]) -> None:
    axes = figure.axes[0]
    handles = [
        axes.scatter([], [], area, colour, marker=marker, label=kind)
        for kind, (colour, marker, area) in STYLES.items()
        if kind in kinds
    ]
    figure.legend(handles=handles, loc='outside upper center', ncols=len(handles))


def _order(cell: Cell) -> tuple[bool, str, float, float]:
    s = cell.sensor
    return s.timing != 'even', s.timing, -s.rate, s.noise


def _row(cell: Cell) -> str:
    noise = cell.sensor.noise
    return f'{sampling(cell)}, {"no noise" if noise == 0.0 else f"noise {noise:g}"}'


def time_series(results: Results) -> Figure:
    """Draw d and its estimates on a held-out recording of each of some cells."""
    chosen = results.best_of_kinds()
    noisy = [c for c in chosen if c.sensor.noise == 1e-3 and c.sensor.timing == 'even']
    first = {(c.sensor.plant, c.disturbance): c for c in reversed(noisy)}
    cells = [first[name] for name in SHOWN if name in first] or list(chosen)[:1]
    figure = Figure(figsize=(9.0, 2.2 * len(cells) + 0.8), layout='constrained')
    panels = figure.subplots(len(cells), 1, sharex=True, squeeze=False)[:, 0]
    for axes, cell in zip(panels, cells, strict=True):
        _estimates(axes, results, cell, chosen[cell][LINEAR][0])
        axes.set_title(f'{cell.plant}, {cell.disturbance}, {_row(cell)}', fontsize=9)
        axes.set_ylabel('d')
    panels[0].legend(ncols=4, fontsize=8, loc='upper right')
    panels[-1].set_xlabel('time [s]')
    return figure


def _estimates(axes: Axes, results: Results, cell: Cell, linear: str) -> None:
    recording = cell.sensor.held_out(cell.disturbance)[2]
    late = recording.t >= 10.0
    t = recording.t[late]
    axes.plot(*envelope(t, recording.d[late]), color=BLACK, linewidth=1.6, label='truth')
    for kind, dashes in ((LINEAR, '--'), (OURS, '-.'), (SELF_TUNING, '-')):
        name = linear if kind == LINEAR else kind
        entry = results.find(cell.sensor, name)
        if entry is not None:
            found = estimates(METHODS[name], cell.sensor.setting(), entry.tuned, [recording])[0]
            curve = envelope(t, found.d[late])
            axes.plot(*curve, dashes, color=STYLES[kind][0], linewidth=1.0, label=kind)
    size = float(abs(recording.d).max())
    axes.set_ylim(-1.6 * size, 1.6 * size)
    axes.grid(alpha=0.3)
