# SPDX-License-Identifier: Apache-2.0
"""Plot the estimates of bags, and a table of metrics; or the fuzzy systems of an observer."""

import argparse
from pathlib import Path

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import select
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.recorded_parameters import recorded_parameters
from fhaosmo_ros.tools.cli.command import Output, run_command
from fhaosmo_ros.tools.cli.options import add_parameter_options, online_parameters
from fhaosmo_ros.tools.plot.curves import metrics, read_curves
from fhaosmo_ros.tools.plot.figures import save_curves
from fhaosmo_ros.tools.plot.fuzzy import fuzzy_figure, rows_of

SUFFIXES = ('.png', '.svg', '.pdf')


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if there is a figure, else none is written."""
    return run_command(_parser(), argv, _plot)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='plot',
        description='Draw the estimates in bags, live and replayed, one over another; or, with '
        '--fuzzy, fuzzy systems: those of a bag, of --params-file and -p, or the default ones.',
    )
    add = parser.add_argument
    add('bags', type=Path, nargs='*', metavar='BAG')
    add(
        '-o', '--output', type=Path, metavar='FILE',
        help='.png, .svg or .pdf (default: BAG.png, or fuzzy.png, in the current folder)',
    )  # fmt: skip
    add('--fuzzy', action='store_true', help='draw membership functions and curves instead')
    add('--force', action='store_true', help='replace an output that exists')
    add('--names', nargs='+', metavar='NAME', help='estimators (default: all in the bags)')
    add('--plant', default='/plant', help='whose topics are the truth (default: %(default)s)')
    add_parameter_options(parser)
    return parser


def _plot(arguments: argparse.Namespace, stop: Stop) -> None:
    if not arguments.bags and not arguments.fuzzy:
        raise ConfigurationError('expected a BAG or --fuzzy, got neither')
    name = 'fuzzy' if arguments.fuzzy else arguments.bags[0].resolve().stem
    path = arguments.output or Path(f'{name}.png')
    if path.suffix not in SUFFIXES:
        raise ConfigurationError(
            f'--output: expected a name that ends in {", ".join(SUFFIXES)}, got {path}'
        )
    if arguments.fuzzy:
        _plot_fuzzy(arguments, path, stop)
        return
    values = online_parameters(arguments)
    with stop.raising():
        curves = [
            c for bag in arguments.bags for c in read_curves(bag, arguments.names, arguments.plant)
        ]
    with Output(path, arguments.force) as output:  # not within raising: it leaves nothing behind
        with stop.raising():
            save_curves(curves, values.get('epsilon', curves[0].epsilon), output.path)
        if stop.is_set():  # Python drops what a signal raises in a destructor or weakref callback
            raise Stopped
        final = output.keep()
    print(f'{metrics(curves)}\nfigure: {final}', flush=True)


def _plot_fuzzy(arguments: argparse.Namespace, path: Path, stop: Stop) -> None:
    """Draw the fuzzy systems of the observer that a bag, files and -p describe."""
    if len(arguments.bags) > 1 or len(arguments.names or []) > 1:
        raise ConfigurationError('--fuzzy: expected at most one BAG and one name')
    recorded = None
    for bag in arguments.bags:
        with BagReader(bag) as reader:
            recorded = recorded_parameters(reader, *arguments.names or [])
        if recorded is None and not arguments.params_file:
            raise ConfigurationError(
                f'bag {bag}: expected the parameters of one estimator, of --names NAME or '
                'the only one, got none; --params-file does without them'
            )
        if recorded and not arguments.channel:
            arguments.channel = recorded.channel
    parameters = OBSERVER_PARAMETERS.complete(
        select(online_parameters(arguments, recorded), OBSERVER_PARAMETERS)
    )
    levels = Observer(parameters).levels
    with Output(path, arguments.force) as output:
        with stop.raising():
            fuzzy_figure(rows_of(parameters, levels)).savefig(output.path, dpi=150)
        final = output.keep()
    print(f'figure: {final}', flush=True)
