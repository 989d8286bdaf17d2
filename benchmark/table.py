# SPDX-License-Identifier: Apache-2.0
"""What was measured, beside what is allowed."""

import textwrap
from typing import NamedTuple


class CannotMeasureError(Exception):
    """Something that a measurement needs is missing; the message is one line."""


class Row(NamedTuple):
    """
    One line of the result.

    Attributes
    ----------
    name : str
        What was measured.
    value : float or None
        None if it could not be measured; then a bar counts as missed.
    unit : str
    bar : float or None
        Highest allowed value, None where there is no bar.
    note : str
        The numbers behind the value.

    """

    name: str
    value: float | None
    unit: str = ''
    bar: float | None = None
    note: str = ''

    @property
    def missed(self) -> bool:
        """True if there is a bar and the value is not within it."""
        return self.bar is not None and (self.value is None or not self.value <= self.bar)

    def cells(self) -> tuple[str, str, str, str, str]:
        """Return name, value, bar, verdict and note as a reader sees them."""
        value = '-' if self.value is None else f'{_short(self.value)} {self.unit}'.strip()
        if self.bar is None:
            return self.name, value, '', '', self.note
        return self.name, value, f'<= {self.bar:g}', 'MISSED' if self.missed else 'pass', self.note


class Table(NamedTuple):
    """
    Figures that are no bars.

    Attributes
    ----------
    title : str
        What they are, in sentences.
    header : tuple of str
    lines : list of tuple of str

    """

    title: str
    header: tuple[str, ...]
    lines: list[tuple[str, ...]]

    def render(self) -> str:
        """Return the title, wrapped, and the columns, aligned to the right."""
        cells = [self.header, *self.lines]
        widths = [max(len(line[k]) for line in cells) for k in range(len(self.header))]
        rows = ('  '.join(f'{c:>{w}}' for c, w in zip(r, widths, strict=True)) for r in cells)
        return '\n'.join([*textwrap.wrap(self.title, 99), '', *rows])

    def markdown(self) -> str:
        """Return the columns for a page."""
        ruled = [self.header, ('---',) * len(self.header), *self.lines]
        return '\n'.join(f'| {" | ".join(line)} |' for line in ruled)


def render(rows: list[Row]) -> str:
    """Return the rows as an aligned table."""
    cells = [('', 'measured', 'allowed', '', ''), *(row.cells() for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(cells[0]))]
    return '\n'.join(
        f'{name:<{widths[0]}}  {value:>{widths[1]}}  {bar:<{widths[2]}}  '
        f'{verdict:<{widths[3]}}  {note}'.rstrip()
        for name, value, bar, verdict, note in cells
    )


def _short(value: float) -> str:
    return f'{value:.0f}' if abs(value) >= 100.0 else f'{value:.3g}'
