# SPDX-License-Identifier: Apache-2.0
"""The comparison's figure: errors beside the linear filter's."""

from matplotlib.figure import Figure
from studies.comparison.cells import PLANTS
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
from studies.comparison.results import Cell, Chosen, number, ratios
from studies.comparison.scores import mean

BLACK = '#000000'
STYLES = {
    USUAL: (BLACK, 'o', 22), ROBUST: ('#56B4E9', '^', 26), SLIDING: ('#CC79A7', 'D', 20),
    PAPER: ('#999999', 'x', 26), OURS: ('#009E73', 's', 24), SELF_TUNING: ('#D55E00', '*', 90),
}  # fmt: skip
"""Okabe-Ito, and a grey; marker and its area."""
FLOOR, CEILING, EDGE = 0.3, 10.0, 35.0
"""Smallest and largest ratio that is drawn, and where the linear filter's error stands."""
TICKS = (0.3, 0.5, 1.0, 2.0, 5.0, 10.0)


def against_linear(chosen: Chosen, jumps: bool) -> Figure:
    """Draw each kind's error over that of the best linear filter: a panel a plant."""
    about = [c for c in chosen if c.jumps == jumps]
    plants = [p for p in PLANTS if any(c.plant == p for c in about)]
    rows = list(dict.fromkeys(_row(c) for c in sorted(about, key=_order)))
    figure = Figure(figsize=(11.0, 0.36 * len(rows) + 1.6), layout='constrained')
    panels = figure.subplots(1, len(plants), sharey=True, squeeze=False)[0]
    for plant, axes in zip(plants, panels, strict=True):
        for at, row in enumerate(rows):
            cells = {c for c in about if c.plant == plant and _row(c) == row}
            if cells:
                error = number(mean(chosen[c][LINEAR] for c in cells))
                axes.text(EDGE, at, error, fontsize=8, va='center', ha='right')
            for kind in KINDS[1:] if cells else ():
                found = ratios(chosen, kind, cells.__contains__)
                if found:
                    colour, marker, area = STYLES[kind]
                    place = min(max(mean(found), FLOOR), CEILING)
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
    handles = [
        panels[0].scatter([], [], area, colour, marker=marker, label=kind)
        for kind, (colour, marker, area) in STYLES.items()
    ]
    figure.legend(handles=handles, loc='outside upper center', ncols=len(handles))
    return figure


def _order(cell: Cell) -> tuple[bool, str, float, float]:
    return cell.timing != 'even', cell.timing, -cell.rate, cell.noise


def _row(cell: Cell) -> str:
    rate = '1 kHz' if cell.rate == 1000.0 else f'{cell.rate:g} Hz'
    timing = '' if cell.timing == 'even' else f', {cell.timing}'
    return f'{rate}{timing}, {f"noise {cell.noise:g}" if cell.noise else "no noise"}'
