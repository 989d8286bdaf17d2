# SPDX-License-Identifier: Apache-2.0
"""All that docs/paper.md shows in numbers: kept in a file, from which its tables are made."""

from collections.abc import Iterable
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from studies.paper import tables
from studies.paper.beyond import LongRun, Row
from studies.paper.cases import preset
from studies.paper.curves import CurveRow
from studies.paper.findings import Scores, WidthMap


class Results(NamedTuple):
    """
    What was measured.

    Attributes
    ----------
    solver : str
        The default one.
    scores : dict
        Of plant and observer simulated together, by solver.
    widths : WidthMap
    schemes, noise : list of Row
        Sampled observers without and with noise.
    long, protection, dead_zones : list of LongRun
    curves : list of CurveRow

    """

    solver: str
    scores: dict[str, Scores]
    widths: WidthMap
    schemes: list[Row]
    noise: list[Row]
    long: list[LongRun]
    protection: list[LongRun]
    dead_zones: list[LongRun]
    curves: list[CurveRow]


def parts(r: Results, every: int = 1) -> dict[str, str]:
    """Return the generated parts of the document; `every`: see `findings.width_map`."""
    return {
        'solvers': tables.solver_table(r.scores, r.solver),
        'findings': tables.findings_table(r.scores, r.solver),
        'observers': tables.observers_table(r.scores),
        'bar': tables.bar_table(r.scores),
        'widths': tables.map_text(r.widths, preset().observer['fuzzy_widths'], every),
        'schemes': tables.beyond_table(r.schemes),
        'noise': tables.beyond_table(r.noise),
        'long': tables.long_table(r.long),
        'deadzone': tables.dead_zone_table(r.dead_zones),
        'protection': tables.protection_table(r.protection),
        'curves': tables.curves_table(r.curves),
    }


def write(results: Results, path: Path) -> None:
    """Write the results as JSON."""
    scores = [
        {'solver': solver, 'observer': name, 'omega': omega} | score
        for solver, by_case in results.scores.items()
        for (name, omega), score in by_case.items()
    ]
    widths = {name: values.tolist() for name, values in results.widths._asdict().items()}
    data = {
        'solver': results.solver,
        'scores': scores,
        'widths': widths | {'holds': np.array(widths['holds'], dtype=int).tolist()},
        **{name: [_plain(row) for row in getattr(results, name)] for name in ROWS},
    }
    lines = (f' {json.dumps(key)}: {_lines(value)}' for key, value in data.items())
    path.write_text('{\n' + ',\n'.join(lines) + '\n}\n', encoding='utf-8')


def read(path: Path) -> Results:
    """Read what `write` has written."""
    data = json.loads(path.read_text(encoding='utf-8'))
    scores: dict[str, Scores] = {}
    for row in data['scores']:
        case = scores.setdefault(row.pop('solver'), {})
        case[row.pop('observer'), row.pop('omega')] = row
    widths = WidthMap(
        np.array(data['widths']['widths']), np.array(data['widths']['holds'], dtype=bool)
    )
    rows = {name: [_row(kind, row) for row in data[name]] for name, kind in ROWS.items()}
    return Results(data['solver'], scores, widths, **rows)


ROWS: dict[str, Any] = {
    'schemes': Row, 'noise': Row, 'long': LongRun, 'protection': LongRun, 'dead_zones': LongRun,
    'curves': CurveRow,
}  # fmt: skip


def _plain(row: Any) -> dict[str, Any]:
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in row._asdict().items()
    }


def _row(kind: Any, values: dict[str, Any]) -> Any:
    lists = {k: np.array(v) for k, v in values.items() if isinstance(v, list)}
    return kind(**(values | lists))


def _lines(value: Any) -> str:
    """Return JSON with one line for each entry of a list, which a diff can show."""
    if not isinstance(value, list):
        return json.dumps(value)
    entries: Iterable[str] = (f'  {json.dumps(entry)}' for entry in value)
    return '[\n' + ',\n'.join(entries) + '\n ]'
