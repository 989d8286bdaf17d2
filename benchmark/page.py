# SPDX-License-Identifier: Apache-2.0
"""docs/speed.md and docs/speed.json: what was measured, a part of the benchmark each."""

from collections.abc import Mapping, Sequence
import json
import os
from pathlib import Path
import platform
from typing import Any

from studies.document import parts, refill
from table import Row, Table

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'speed.md'
PROCESSOR = 'model name'
"""In /proc/cpuinfo."""


def machine() -> str:
    """Return what this is measured on, and how busy it is now."""
    found = [platform.machine()]
    with Path('/proc/cpuinfo').open(encoding='utf-8') as lines:
        found = [line.split(':')[1].strip() for line in lines if PROCESSOR in line][:1] or found
    load = f'load {os.getloadavg()[0]:.1f} at the start'
    return ', '.join([
        *found, f'{os.cpu_count()} cores', f'Python {platform.python_version()}', load,
    ])  # fmt: skip


def kept() -> dict[str, Any]:
    """Return what the page shows: for each part its machine, rows and tables."""
    results: dict[str, Any] = json.loads(PAGE.with_suffix('.json').read_text(encoding='utf-8'))
    return results


def part(results: Sequence[Row | Table], where: str) -> dict[str, Any]:
    """Return the results of one part as JSON can hold them."""
    return {
        'machine': where,
        'rows': [r._asdict() for r in results if isinstance(r, Row)],
        'tables': [r._asdict() for r in results if isinstance(r, Table)],
    }


def text(found: Mapping[str, Any]) -> str:
    """Return the results of one part for the page."""
    rows = [Row(**row).cells() for row in found['rows']]
    bars = any(bar for _, _, bar, _, _ in rows)  # else two columns are empty
    shown = [row if bars else (*row[:2], row[4]) for row in rows]
    header = ('', 'measured', 'allowed', '', '') if bars else ('', 'measured', '')
    blocks = [Table('', header, shown).markdown()]
    for table in found['tables']:
        blocks += [table['title'], Table(**table).markdown()]
    return '\n\n'.join([*blocks, f'Machine: {found["machine"]}.'])


def write(measured: Mapping[str, Mapping[str, Any]]) -> list[Path]:
    """Replace these parts of page and results; the others stay."""
    shown = parts(PAGE.read_text(encoding='utf-8'))
    before = kept() if PAGE.with_suffix('.json').exists() else {}
    results = {name: (before | dict(measured)).get(name) for name in shown}
    results = {name: found for name, found in results.items() if found}
    return refill(PAGE, {name: text(found) for name, found in results.items()}, results=results)
