# SPDX-License-Identifier: Apache-2.0
"""What the comparison has found: a line a cell and method in docs/evidence/comparison.csv."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

from studies.comparison.cells import PLANTS
from studies.comparison.evaluation import METHODS
from studies.comparison.methods.method import KINDS, LINEAR
from studies.comparison.scores import mean
from studies.evidence import markdown, Row

CLOSE = 0.05
"""Errors within this part of another one count as equal."""


class Cell(NamedTuple):
    """Plant, kind of d, standard deviation of the noise on y, samples a second, timing."""

    plant: str
    d: str
    noise: float
    rate: float
    timing: str

    @property
    def jumps(self) -> bool:
        """True for a d that jumps."""
        return PLANTS[self.plant].disturbances[self.d].jumps


Chosen = dict[Cell, dict[str, float]]
"""Errors of d by cell and kind of method."""

GROUPS: dict[str, Callable[[Cell], bool]] = {
    'd without jumps': lambda c: c.noise > 0.0 and not c.jumps,
    'd with jumps': lambda c: c.noise > 0.0 and c.jumps,
    'no noise, without jumps': lambda c: c.noise == 0.0 and not c.jumps,
    'no noise, with jumps': lambda c: c.noise == 0.0 and c.jumps,
}


def best_of_kinds(rows: Iterable[Row]) -> Chosen:
    """Return for each cell the method of each kind whose error in training is smallest."""
    chosen: Chosen = {}
    for row in sorted(rows, key=lambda row: row['training']):
        errors = chosen.setdefault(Cell(*(row[name] for name in Cell._fields)), {})
        errors.setdefault(METHODS[row['method']].kind, row['error'])
    return chosen


def ratios(chosen: Chosen, kind: str, about: Callable[[Cell], bool]) -> list[float]:
    """Return the errors of d over those of the best linear filter, of the cells with both."""
    return [
        errors[kind] / errors[LINEAR]
        for cell, errors in chosen.items()
        if about(cell) and kind in errors
    ]


def texts(rows: Iterable[Row]) -> dict[str, str]:
    """Return the part of the page: ratios by kind and group, and how often a kind is the best."""
    chosen, lines = best_of_kinds(rows), []
    for kind in KINDS:
        parts = [ratios(chosen, kind, about) for about in GROUPS.values()]
        best = sum(
            kind in errors and errors[kind] <= (1.0 + CLOSE) * min(errors.values())
            for errors in chosen.values()
        )
        shown = ['1' if kind == LINEAR else _spread(part) for part in parts]
        lines.append([kind, *shown, f'{best} of {len(chosen)}'])
    head = ['', *GROUPS, f'at most {100.0 * CLOSE:g} % behind the best']
    return {'summary': markdown(head, lines)}


def _spread(values: list[float]) -> str:
    """Return a geometric mean and the largest value."""
    return f'{number(mean(values))} ({number(max(values))})' if values else ''


def number(x: float) -> str:
    """Return a number as text."""
    if not x < 1e6:
        return '∞'
    if x >= 100.0:
        return f'{x:.3g}' if x < 1e4 else f'{x:.0e}'
    return f'{x:.2g}' if x < 0.1 else f'{x:.2f}'
