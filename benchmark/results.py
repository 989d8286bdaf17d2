# SPDX-License-Identifier: Apache-2.0
"""What was measured, beside what is allowed; and where docs/evidence.md has it from."""

from collections.abc import Iterable, Mapping
import os
from pathlib import Path
import platform
from typing import Any, NamedTuple

from studies import evidence

NAME = 'speed'
SHOWN = (
    'core step / same step in C (-O3)',
    'core step, sign, explicit',
    'core step, fuzzy_adaptive, explicit',
    'core step, fuzzy_adaptive, implicit',
    'step, self-tuning, paper_plant',
    'CPU, estimator / empty node, y 1000 Hz, estimates 1000 Hz',
    'CPU, estimator / empty node, 7 joints 1000 Hz, estimates 100 Hz',
    'samples lost, y 1000 Hz, estimates 1000 Hz',
    'latency, 99 %, y 1000 Hz, estimates on samples',
    'share of a core, an arm of 7 joints 1000 Hz, estimates 250 Hz',
    'replay to a bag / rosbags reads',
)
"""Rows of the page."""


class Row(NamedTuple):
    """One line of the result."""

    name: str
    value: float | None  # none if it could not be measured; then a bar counts as missed
    unit: str = ''
    bar: float | None = None  # highest allowed value
    note: str = ''  # the numbers behind the value

    @property
    def missed(self) -> bool:
        """True if there is a bar and the value is not within it."""
        return self.bar is not None and (self.value is None or not self.value <= self.bar)

    @property
    def cells(self) -> tuple[str, str, str]:
        """Name, value and bar as a reader sees them."""
        value = '-'
        if self.value is not None:
            digits = '.0f' if abs(self.value) >= 100.0 else '.3g'
            value = f'{self.value:{digits}} {self.unit or ""}'.strip()
        return self.name, value, '' if self.bar is None else f'<= {self.bar:g}'


def render(rows: Iterable[Row]) -> str:
    """Return the rows as a table."""
    verdicts = ('', 'pass', 'MISSED')
    lines = [(*r.cells, verdicts[(r.bar is not None) + r.missed], r.note) for r in rows]
    return evidence.markdown(['', 'measured', 'allowed', '', ''], lines)


def machine() -> str:
    """Return what this is measured on, and how busy it is now."""
    lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    found = [line.split(':')[1].strip() for line in lines if 'model name' in line][:1]
    load = f'load {os.getloadavg()[0]:.1f} at the start'
    python = f'Python {platform.python_version()}'
    return ', '.join([*(found or [platform.machine()]), f'{os.cpu_count()} cores', python, load])


def texts(rows: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Return the part of the page, from the table."""
    found = {row['name']: Row(*(row[k] for k in Row._fields)) for row in rows}
    lines = [found[name].cells for name in SHOWN]
    return {NAME: evidence.markdown(['', 'measured', 'allowed'], lines)}
