# SPDX-License-Identifier: Apache-2.0
"""docs/evidence.md and the tables and figures in the folder beside it."""

from collections.abc import Iterable, Mapping, Sequence
import csv
from pathlib import Path
import re
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.tuning.command import markdown as markdown  # for all studies
from matplotlib.figure import Figure
import numpy as np

DOCS = Path(__file__).resolve().parents[1] / 'docs'
PAGE, FOLDER = 'evidence.md', 'evidence'
PART = '<!-- begin {0} -->\n{1}\n<!-- end {0} -->'
PATTERN = re.compile(r'<!-- begin (?P<name>\S+) -->\n(?P<text>.*?)\n?<!-- end (?P=name) -->', re.S)
Row = dict[str, Any]  # a line of a table, by column; numbers are floats
SELF, TUNED, USUAL, ROBUST, OTHER, GREY = (
    ('#D55E00', '*', 90), ('#009E73', 's', 22), ('#0072B2', 'o', 24), ('#56B4E9', '^', 26),
    ('#CC79A7', 'D', 20), ('#999999', 'x', 26),
)  # fmt: skip
"""Okabe-Ito, and a grey; marker and its area."""
TICKS = (0.1, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
FLOOR, CEILING = 0.1, 10.0  # smallest and largest ratio that is drawn


def read(name: str, docs: Path = DOCS) -> list[Row]:
    """Return the lines of a table in the folder beside the page; none where there is no such."""
    path = docs / FOLDER / f'{name}.csv'
    if not path.exists():
        return []
    with path.open(newline='', encoding='utf-8') as file:
        return [{k: _value(text) for k, text in row.items()} for row in csv.DictReader(file)]


def _value(text: str) -> float | str | None:
    try:
        return float(text) if text else None
    except ValueError:
        return text


def rounded(rows: Iterable[Mapping[str, Any]]) -> list[Row]:
    """Return lines as they will be read: numbers with six digits."""
    return [
        {k: float(f'{v:.6g}') if isinstance(v, float | int) else v for k, v in row.items()}
        for row in rows
    ]


def parts(document: str) -> dict[str, str]:
    """Return the generated parts of a document by name."""
    return {match['name']: match['text'] for match in PATTERN.finditer(document)}


def filled(document: str, texts: Mapping[str, str]) -> str:
    """Return the document with these parts replaced; others stay, and all must have markers."""
    present = parts(document)
    if not texts.keys() <= present.keys():
        raise ConfigurationError(
            f'markers of the document: expected {", ".join(sorted(texts))}, '
            f'got {", ".join(sorted(present)) or "none"}'
        )
    present |= texts
    return PATTERN.sub(lambda match: PART.format(match['name'], present[match['name']]), document)


def publish(
    docs: Path,
    tables: Mapping[str, Sequence[Mapping[str, Any]]],
    texts: Mapping[str, str],
    figures: Mapping[str, Figure],
) -> None:
    """
    Write tables and figures by name into the folder beside the page, and fill the page if there.

    `docs` is the folder of the page, made where there is none; `texts` are parts of the page.
    """
    page, folder = docs / PAGE, docs / FOLDER
    if page.exists():
        page.write_text(filled(page.read_text(encoding='utf-8'), texts), encoding='utf-8')
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        with (folder / f'{name}.csv').open('w', newline='', encoding='utf-8') as file:
            columns = dict.fromkeys(column for row in rows for column in row)
            table = csv.DictWriter(file, list(columns), lineterminator='\n')
            table.writeheader()
            for row in rows:
                numbers = {k: f'{v:.6g}' for k, v in row.items() if isinstance(v, float | int)}
                table.writerow(row | numbers)
    for name, figure in figures.items():
        figure.savefig(folder / f'{name}.png', dpi=110)
    print(f'{docs}: {", ".join([*tables, *figures])}')
    for body in texts.values():
        print(f'\n{body}')


def draw_ratios(
    panels: Mapping[str, Mapping[str, Mapping[str, float]]],
    styles: Mapping[str, tuple[str, str, int]],
    text: str,
) -> Figure:
    """
    Draw ratios of errors, which `text` describes, a panel a plant.

    `panels` has them by title of the panel, row, and method; `styles` are by method.
    """
    rows = list(dict.fromkeys(row for panel in panels.values() for row in panel))
    figure = Figure(figsize=(11.0, 0.3 * len(rows) + 1.6), layout='constrained')
    every = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for (title, panel), axes in zip(panels.items(), every, strict=True):
        for name, (colour, marker, area) in styles.items():
            points = {rows.index(row): r[name] for row, r in panel.items() if name in r}
            x, front = np.clip(list(points.values()), FLOOR, CEILING), 3 + (colour == SELF[0])
            axes.scatter(x, list(points), area, colour, marker=marker, label=name, zorder=front)
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
