# SPDX-License-Identifier: Apache-2.0
"""Plot the estimates of one bag or of several: PNG, SVG or PDF, and a table of metrics."""

import argparse
from pathlib import Path

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.cli.options import add_parameter_options, online_parameters
from fhaosmo_ros.tools.cli.output import Output
from fhaosmo_ros.tools.plot.curves import metrics, read_curves
from fhaosmo_ros.tools.plot.figures import save_curves, show

SUFFIXES = ('.png', '.svg', '.pdf')


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if there is a figure, else none is written."""
    return run_command(_parser(), argv, _run)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='plot', description='Draw the estimates in bags: live and replayed, one over another.'
    )
    add = parser.add_argument
    add('bags', type=Path, nargs='+', metavar='BAG')
    add(
        '-o',
        '--output',
        type=Path,
        metavar='FILE',
        help='.png, .svg or .pdf (default: BAG.png in the current folder)',
    )
    add('--force', action='store_true', help='replace an output that exists')
    add('--show', action='store_true', help='open a window too')
    add('--names', nargs='+', metavar='NAME', help='estimators (default: all in the bags)')
    add('--plant', default='/plant', help='whose topics are the truth (default: %(default)s)')
    add_parameter_options(parser)
    return parser


def _run(arguments: argparse.Namespace, stop: Stop) -> None:
    with stop.raising():
        _plot(arguments, stop)


def _plot(arguments: argparse.Namespace, stop: Stop) -> None:
    path = arguments.output or Path(f'{arguments.bags[0].resolve().stem}.png')
    if path.suffix not in SUFFIXES:
        raise ConfigurationError(
            f'--output: expected a name that ends in {", ".join(SUFFIXES)}, got {path}'
        )
    values = online_parameters(arguments)
    curves = [
        c for bag in arguments.bags for c in read_curves(bag, arguments.names, arguments.plant)
    ]
    with Output(path, arguments.force) as output:
        save_curves(curves, values.get('epsilon', curves[0].epsilon), output.path, arguments.show)
        if stop.is_set():  # Python drops what a signal raises in a destructor or weakref callback
            raise Stopped
        final = output.keep()
    print(f'{metrics(curves)}\nfigure: {final}', flush=True)
    if arguments.show:
        show()
