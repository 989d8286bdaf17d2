# SPDX-License-Identifier: Apache-2.0
"""Find gains of the estimator that fit a sensor, a plant and a family of disturbances."""

import argparse
from importlib.util import find_spec
import os
from pathlib import Path
import shlex
import sys
from typing import Any

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import ParameterTable
from fhaosmo_ros.core.parameter_file import load
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS, MODEL
from fhaosmo_ros.stop_signals import Stop, stop_on_signals
from fhaosmo_ros.tools.options import assigned
from fhaosmo_ros.tools.output import Output
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.source import BagChoice, Data, from_bag, simulated

TRIALS = 1000
NEEDED = ('optuna', 'cmaes', 'control')
"""Only this command needs them, so a robot may lack them."""
BOTH = ParameterTable(TUNE_PARAMETERS.values(), ESTIMATOR_PARAMETERS.values())


def main(argv: list[str] | None = None) -> int:
    """
    Run the command.

    Returns
    -------
    int
        0 if the output is complete (also where Ctrl-C ended the search early), 130 if it was
        interrupted before the first trial, 2 for wrong input; then nothing is written.

    """
    arguments = _parser().parse_args(argv)
    stop = stop_on_signals()
    given = sys.argv[1:] if argv is None else argv
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        print(
            f'tune: error: {" and ".join(missing)} not installed: make tune does it, or '
            "python3 -m pip install 'optuna>=4,<6' cmaes control",
            file=sys.stderr,
        )
        return 1
    try:
        return _tune(arguments, shlex.join(['tune', *given]), stop)
    except ConfigurationError as error:
        print(f'tune: error: {error}', file=sys.stderr)
        return 2
    except OSError as error:
        print(f'tune: error: output: {error.strerror}: {error.filename}', file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='tune', description=__doc__,
        epilog='Everything else (model, noise, rate, disturbances, what to search, weights) is a '
        'parameter: docs/tuning.md.',
    )  # fmt: skip
    add = parser.add_argument
    add(
        '-o', '--output', type=Path, default=Path('tune_output'), metavar='FOLDER',
        help='for gains.yaml, report.md and the figures (default: %(default)s)',
    )  # fmt: skip
    add('--force', action='store_true', help='replace an output that exists')
    add(
        '--params-file', type=Path, action='append', default=[], metavar='FILE',
        help="parameters: sections of the estimator, the plant and 'tune', or /**",
    )  # fmt: skip
    add(
        '-p', '--param', action='append', default=[], metavar='NAME:=VALUE',
        help='set one parameter; wins over the file',
    )  # fmt: skip
    add(
        '--trials', type=int, default=TRIALS, metavar='N',
        help='that the study shall hold at the end (default: %(default)s)',
    )  # fmt: skip
    add('--jobs', type=int, metavar='N', help='trials at a time (default: one a core)')
    add('--seed', type=int, default=1, help='of recordings and search (default: %(default)s)')
    add('--sampler', choices=('cmaes', 'tpe', 'random'), default='cmaes', help='(%(default)s)')
    add(
        '--pareto', choices=('chatter', 'settling'), nargs='?', const='chatter',
        help='search the front of the error and this one',
    )  # fmt: skip
    add(
        '--storage', metavar='URL',
        help='of an Optuna study that several tune share: a data base such as '
        'postgresql://..., or a file for a journal (default: FOLDER.journal)',
    )  # fmt: skip
    bag = parser.add_argument_group('from a bag')
    add = bag.add_argument
    add(
        '--bag', type=Path,
        help='with the truth in it: tune on it; without: take noise, rate and jitter from its y',
    )  # fmt: skip
    add('--topic', default='/y', help='topic of the measured output (%(default)s)')
    add('--field', help="number in its messages, such as 'position[2]' (default: the only one)")
    add('--input-topic', default='/u', help='topic of the known input (%(default)s)')
    add('--input-field', help='number in its messages')
    add('--stamp', choices=('auto', 'header', 'bag'), default='auto', help='where dt comes from')
    add('--plant', default='/plant', help='whose topics are the truth (%(default)s)')
    return parser


def _tune(arguments: argparse.Namespace, command: str, stop: Stop) -> int:
    from fhaosmo_ros.tools.tuning.tuner import Tuner
    from fhaosmo_ros.tools.tuning.writer import write

    if arguments.trials < 1 or (arguments.jobs or 1) < 1 or arguments.seed < 0:
        raise ConfigurationError(
            'expected --trials >= 1, --jobs >= 1 and --seed >= 0, got '
            f'{arguments.trials}, {arguments.jobs} and {arguments.seed}'
        )
    estimator, tuning = read_parameters(arguments.params_file, arguments.param)
    with Output(arguments.output, arguments.force) as output:
        data = _data(arguments, tuning)
        print(
            f'{len(data.training)} recordings to train on, {len(data.held_out)} held out: '
            f'{data.origin}'
        )
        jobs = arguments.jobs or os.cpu_count() or 1
        tuner = Tuner(
            data, estimator, TUNE_PARAMETERS.defaults() | tuning, arguments.seed, jobs,
            stop.is_set,
        )  # fmt: skip
        storage = arguments.storage or f'{arguments.output}.journal'
        if arguments.storage is None and Path(storage).exists():
            print(f'{storage}: of a run that was cut short; goes on where it asked the same')
        result = tuner.search(
            arguments.trials, jobs, storage, arguments.sampler, arguments.pareto, stop.is_set,
        )  # fmt: skip
        if result is None:
            print('tune: interrupted before the first trial, nothing written', file=sys.stderr)
            return 130
        text = write(output.path, tuner, result, command)
        if arguments.storage is None:
            # Complete: it belongs to the output now, and the next run begins anew.
            Path(storage).replace(output.path / 'study.journal')
            Path(f'{storage}.lock').unlink(missing_ok=True)
        final = output.keep()
    print(f'\n{text}\n')
    print(f'output: {final}/gains.yaml, report.md, figures')
    print(f'use it: ros2 run fhaosmo_ros estimator --ros-args --params-file {final}/gains.yaml')
    return 0


def read_parameters(files: list[Path], rules: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Return what is set for the estimator, and for the tuning.

    Raises
    ------
    ConfigurationError
        A file, a name or a value that can't be used.

    """
    estimator: dict[str, Any] = {}
    tuning: dict[str, Any] = {}
    for path in files:
        found = load(path, 'estimator')
        estimator |= found
        # Where only the estimator has a model, the plant has the same one.
        tuning |= {p.name: found[p.name] for p in MODEL if p.name in found}
        tuning |= load(path, 'plant', TUNE_PARAMETERS) | load(path, 'tune', TUNE_PARAMETERS)
    values = assigned(rules, BOTH)
    estimator |= {name: v for name, v in values.items() if name in ESTIMATOR_PARAMETERS}
    tuning |= {name: v for name, v in values.items() if name in TUNE_PARAMETERS}
    return estimator, tuning


def _data(arguments: argparse.Namespace, tuning: dict[str, Any]) -> Data:
    values = TUNE_PARAMETERS.defaults() | tuning
    if arguments.bag is None:
        return simulated(values, arguments.seed)
    choice = BagChoice(
        arguments.bag, arguments.topic, arguments.field, arguments.input_topic,
        arguments.input_field, arguments.stamp, arguments.plant.rstrip('/'),
    )  # fmt: skip
    return from_bag(choice, values, set(tuning), arguments.seed)


if __name__ == '__main__':
    sys.exit(main())
