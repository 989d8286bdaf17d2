# SPDX-License-Identifier: Apache-2.0
"""`python -m fhaosmo_ros.tools.parameter_docs` writes docs/parameters.md."""

from pathlib import Path
import sys

from fhaosmo_ros.core.parameter import Parameter
from fhaosmo_ros.core.parameters import (
    DIAGNOSTICS,
    ESTIMATOR_NODE,
    MODEL,
    OBSERVER,
    PLANT_MODEL,
    PLANT_NODE,
    SAMPLING,
)

HEAD = """# Parameters

Generated from `fhaosmo_ros/core/parameters.py` by `python -m fhaosmo_ros.tools.parameter_docs`.
"""
NOTE = """
A list takes one value for every level, or one a level, where it says so. An integer is accepted
where a number is meant. "live" parameters change in a running node with `ros2 param set`, from the
next sample on and without a jump of the estimate. The others are read when the estimator is
configured, and can be set while it is unconfigured (`ros2 lifecycle set /estimator cleanup`);
the plant, and `autostart`, read them at the start.
"""
GROUPS = (
    ('Model (estimator and plant)', MODEL),
    ('Observer (estimator)', OBSERVER),
    ('Sampling (estimator)', SAMPLING),
    ('Node (estimator)', ESTIMATOR_NODE),
    ('Diagnostics (estimator)', DIAGNOSTICS),
    ('Simulation (plant)', PLANT_MODEL),
    ('Publishing (plant)', PLANT_NODE),
)


def markdown() -> str:
    """Return the text of docs/parameters.md."""
    parts = [HEAD, NOTE]
    for title, group in GROUPS:
        parts.append(f'\n## {title}\n\n| name | default | allowed | live | what it does |\n')
        parts.append('|---|---|---|---|---|\n')
        parts += [_row(parameter) for parameter in group]
    return ''.join(parts)


def _row(p: Parameter) -> str:
    default = str(p.default).lower() if isinstance(p.default, bool) else p.default
    allowed = p.allowed + (f'; length {p.lengths}' if p.lengths else '')
    cells = (f'`{p.name}`', f'`{default}`', allowed, 'yes' if p.live else 'no', p.text)
    # A bar inside a cell would end it.
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |\n'


def main() -> int:
    """Write docs/parameters.md of this checkout."""
    path = Path(__file__).resolve().parents[2] / 'docs' / 'parameters.md'
    path.write_text(markdown(), encoding='utf-8')
    print(path)
    return 0


if __name__ == '__main__':
    sys.exit(main())
