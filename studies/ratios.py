# SPDX-License-Identifier: Apache-2.0
"""The figure of the comparison and of use everywhere: ratios of errors, a panel a plant."""

from collections.abc import Mapping

from matplotlib.figure import Figure

SELF, TUNED, USUAL, ROBUST, OTHER, GREY = (
    ('#D55E00', '*', 90), ('#009E73', 's', 22), ('#0072B2', 'o', 24), ('#56B4E9', '^', 26),
    ('#CC79A7', 'D', 20), ('#999999', 'x', 26),
)  # fmt: skip
"""Okabe-Ito, and a grey; marker and its area."""
TICKS = (0.1, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
FLOOR, CEILING = 0.1, 10.0
"""Smallest and largest ratio that is drawn."""


def draw(
    panels: Mapping[str, Mapping[str, Mapping[str, float]]],
    styles: Mapping[str, tuple[str, str, int]],
    text: str,
) -> Figure:
    """
    Draw ratios.

    Parameters
    ----------
    panels : mapping
        Ratios by title of the panel, row, and method.
    styles : mapping
        Colour, marker and area by method.
    text : str
        What the ratio is.

    """
    rows = list(dict.fromkeys(row for panel in panels.values() for row in panel))
    figure = Figure(figsize=(11.0, 0.3 * len(rows) + 1.6), layout='constrained')
    every = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for (title, panel), axes in zip(panels.items(), every, strict=True):
        for name, (colour, marker, area) in styles.items():
            points = [
                (min(max(ratios[name], FLOOR), CEILING), rows.index(row))
                for row, ratios in panel.items()
                if name in ratios
            ]
            x, y = zip(*points, strict=True) if points else ((), ())
            front = 4 if (colour, marker, area) == SELF else 3
            axes.scatter(x, y, area, colour, marker=marker, label=name, zorder=front)
        axes.axvline(1.0, color='#000000', linewidth=0.8)
        axes.set(xscale='log', xlim=(0.8 * FLOOR, 1.2 * CEILING), title=title)
        axes.set_yticks(range(len(rows)), rows)
        axes.set_xticks(TICKS, [f'{x:g}' for x in TICKS])
        axes.xaxis.set_minor_formatter('')
        axes.grid(alpha=0.3)
    every[0].invert_yaxis()
    figure.supxlabel(f'{text} ({FLOOR:g}, {CEILING:g}: that or beyond)', fontsize='medium')
    handles = every[0].get_legend_handles_labels()
    figure.legend(*handles, loc='outside upper center', ncols=len(styles), fontsize='small')
    return figure
