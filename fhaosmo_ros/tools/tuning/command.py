# SPDX-License-Identifier: Apache-2.0
"""Find gains of the estimator that fit a sensor, a plant and a family of disturbances."""

import argparse
import os
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.declaration import ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, MODEL
from fhaosmo_ros.core.simulation.recordings import SENSOR
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.inputs import BagInputs
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import output_at, run_command
from fhaosmo_ros.tools.cli.options import add_value_options, assigned
from fhaosmo_ros.tools.tuning import report
from fhaosmo_ros.tools.tuning.identify import Identification
from fhaosmo_ros.tools.tuning.linear_gains import chosen_otherwise
from fhaosmo_ros.tools.tuning.objective import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.tuner import simulated, Tuner

TRIALS = 1000
BOTH = ParameterTable(TUNE_PARAMETERS.declared, ESTIMATOR_PARAMETERS.declared)


def main(argv: list[str] | None = None) -> int:
    """Run the command; a search that Ctrl-C ends after the first trial is written, too."""
    parser = argparse.ArgumentParser(
        prog='tune',
        description=__doc__,
        epilog='Everything else (model, noise, rate, disturbances, what to search, weights) is a '
        'parameter: docs/offline.md.',
    )
    add = parser.add_argument
    add(
        '-o', '--output', type=Path, default=Path('tune_output'), metavar='FOLDER',
        help='for gains.yaml and report.md (default: %(default)s)',
    )  # fmt: skip
    add('--force', action='store_true', help='replace an output that exists')
    add_value_options(
        parser, "parameters: sections of the estimator, the plant and 'tune', or /**"
    )
    add(
        '--bag', type=Path,
        help='find the gains that are likeliest for its y (of input_topic, input_field)',
    )  # fmt: skip
    add = parser.add_argument_group('from simulated recordings').add_argument
    add(
        '--trials', type=int, default=TRIALS, metavar='N',
        help='that the study shall hold at the end (default: %(default)s)',
    )  # fmt: skip
    add('--jobs', type=int, metavar='N', help='trials at a time (default: one a core)')
    add('--seed', type=int, default=1, help='of recordings and search (default: %(default)s)')
    add(
        '--storage', metavar='URL',
        help='data base of an Optuna study that several tune share, and that can be continued: '
        'sqlite:///study.db, postgresql+psycopg://... (default: in memory)',
    )  # fmt: skip
    return run_command(parser, argv, _tune)


def _tune(arguments: argparse.Namespace, stop: Stop) -> None:
    if arguments.trials < 1 or (arguments.jobs or 1) < 1 or arguments.seed < 0:
        raise ConfigurationError(
            'expected --trials >= 1, --jobs >= 1 and --seed >= 0, got '
            f'{arguments.trials}, {arguments.jobs} and {arguments.seed}'
        )
    estimator, tuning = read_parameters(arguments.params_file, arguments.param)
    with output_at(arguments.output, arguments.force) as folder:
        if arguments.bag:
            with stop.raising():
                parameters, text = _of_bag(arguments.bag, estimator, tuning)
        else:
            values = TUNE_PARAMETERS.complete(tuning)
            with stop.raising():
                training, held_out = simulated(values, arguments.seed)
                print(f'{len(training)} recordings to train on, {len(held_out)} held out')
                tuner = Tuner(training, estimator, values, arguments.seed)
            jobs = arguments.jobs or os.cpu_count() or 1
            study = tuner.search(arguments.trials, jobs, arguments.storage, stop.is_set)
            parameters, text = report.of_search(tuner, study, held_out)
        report.save(folder, arguments.command_line, parameters, text)
    gains = arguments.output / 'gains.yaml'
    print(f'\n{text}\n\noutput: {gains}, report.md')
    print(f'use it: ros2 run fhaosmo_ros estimator --ros-args --params-file {gains}')


def _of_bag(
    path: Path, estimator: dict[str, Any], tuning: dict[str, Any]
) -> tuple[dict[str, Any], str]:
    """Return the gains for what the y of a bag shows, and a report of them."""
    if others := chosen_otherwise(estimator):
        raise ConfigurationError(
            f'--bag: expected gains of structure levant, got {", ".join(others)} set. Leave that '
            'out; or tune by a simulated family: without --bag, with noise_std, rms_of_d and '
            'band_of_d as this command finds them'
        )
    given = ParameterTable(MODEL).part_of(tuning) | estimator
    values = ESTIMATOR_PARAMETERS.complete(given)
    given |= {name: values[name] for name in ('order', 'phi')}
    model = TriangularModel.of(values)
    with BagReader(path) as reader:
        inputs = BagInputs(reader, values, model)
        samples, field = inputs.samples()
        if field.wraps:
            samples = samples.unwrapped()
        u = inputs.at(samples)
    t = (samples.stamps - samples.stamps[0]) * 1e-9
    found = Identification((t, samples.values, u), model, values, given)
    return report.of_bag(found, path.resolve().name)


def read_parameters(files: list[Path], rules: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what files and rules set for the estimator, and for the tuning."""
    estimator: dict[str, Any] = {}
    tuning: dict[str, Any] = {}
    for path in files:
        found = load(path, 'estimator')
        estimator |= found
        # Where only the estimator has a model, the plant has the same one; and so the sensor.
        tuning |= ParameterTable(MODEL, SENSOR).part_of(found)
        tuning |= load(path, 'plant', TUNE_PARAMETERS) | load(path, 'tune', TUNE_PARAMETERS)
    given = assigned(rules, BOTH)
    estimator |= ESTIMATOR_PARAMETERS.part_of(given)
    return estimator, tuning | TUNE_PARAMETERS.part_of(given)
