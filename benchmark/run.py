# SPDX-License-Identifier: Apache-2.0
"""
Measure speed as ratios within one run, and say which bars are met (`make bench`).

With `--page`, docs/evidence/speed.csv is written anew, each part as soon as it is measured.

Exit code 0 if all bars are met, 1 if one is missed, 2 if something cannot be measured, 130 after
Ctrl-C.
"""

import argparse
import sys

import core_step
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
import node
import replay
from results import machine, NAME, render, Row, texts
from studies import evidence

PARTS = {
    'core': core_step.measure, 'node': node.measure, 'startup': node.startup,
    'replay': replay.measure,
}  # fmt: skip


def main() -> int:
    """Measure and print; see the top of this file for the exit code."""
    parser = argparse.ArgumentParser(prog='make bench', description='Measure speed.')
    parser.add_argument(
        '--quick', action='store_true', help='small sizes, and missed bars do not fail'
    )
    parser.add_argument('--only', choices=PARTS, help='one part only')
    parser.add_argument('--page', action='store_true', help='write the table in docs/ anew')

    def body(arguments: argparse.Namespace, stop: Stop) -> int:
        if arguments.page and arguments.quick:
            parser.error('--page shows full measurements: expected no --quick, got --quick')
        rows: list[Row] = []
        where = machine()
        with stop.raising():
            for part in [arguments.only] if arguments.only else PARTS:
                found = PARTS[part](arguments.quick)
                if arguments.page:
                    publish(part, found, where)
                rows += found
        print(f'{where}\n\n{render(rows)}')
        return 1 if any(row.missed for row in rows) and not arguments.quick else 0

    return run_command(parser, None, body)


def publish(part: str, rows: list[Row], where: str) -> None:
    """Replace the lines of a part in the table, and the rows of the page."""
    kept = [row for row in evidence.read(NAME) if row['part'] != part]
    new = evidence.rounded({'part': part, **row._asdict(), 'machine': where} for row in rows)
    evidence.publish(evidence.DOCS, {NAME: [*kept, *new]}, texts([*kept, *new]), {})


if __name__ == '__main__':
    sys.exit(main())
