# SPDX-License-Identifier: Apache-2.0
"""Plot the estimates of bags, and a table of metrics."""

import argparse
from pathlib import Path

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import output_at, run_command
from fhaosmo_ros.tools.plot.curves import metrics, read_curves
from fhaosmo_ros.tools.plot.figures import save_curves

SUFFIXES = ('.png', '.svg', '.pdf')


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if there is a figure, else none is written."""
    parser = argparse.ArgumentParser(
        prog='plot',
        description='Draw the estimates in bags, live and replayed, one over another.',
    )
    add = parser.add_argument
    add('bags', type=Path, nargs='+', metavar='BAG')
    add(
        '-o', '--output', type=Path, metavar='FILE',
        help='.png, .svg or .pdf (default: BAG.png in the current folder)',
    )  # fmt: skip
    add('--force', action='store_true', help='replace an output that exists')
    add('--names', nargs='+', metavar='NAME', help='estimators (default: all in the bags)')
    add('--plant', default='/plant', help='whose topics are the truth (default: %(default)s)')
    return run_command(parser, argv, _plot)


def _plot(arguments: argparse.Namespace, stop: Stop) -> None:
    path = arguments.output or Path(f'{arguments.bags[0].resolve().stem}.png')
    if path.suffix not in SUFFIXES:
        raise ConfigurationError(
            f'--output: expected a name that ends in {", ".join(SUFFIXES)}, got {path}'
        )
    with stop.raising():
        curves = [
            c for bag in arguments.bags for c in read_curves(bag, arguments.names, arguments.plant)
        ]
    # Not within raising: it leaves nothing behind.
    with output_at(path, arguments.force) as figure, stop.raising():
        save_curves(curves, figure)
    late = [c.part(slice(len(c.stamps) // 2, None)) for c in curves]
    print(f'{metrics(late, "2nd half")}\nfigure: {path}', flush=True)
