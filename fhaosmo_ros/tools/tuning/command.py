# SPDX-License-Identifier: Apache-2.0
"""Find gains of the estimator that fit a sensor, a plant and a family of disturbances."""

import argparse
from collections.abc import Iterable, Iterator, Sequence
import math
import os
from pathlib import Path
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.declaration import ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import dumps, load
from fhaosmo_ros.core.parameters.per_channel import of_named_channel, split
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, MODEL
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import SENSOR
from fhaosmo_ros.inputs import with_joints
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.recorded import BagInputs
from fhaosmo_ros.tools.cli.command import add_value_options, output_at, run_command, values_of
from fhaosmo_ros.tools.tuning.identify import Identification, SURE
from fhaosmo_ros.tools.tuning.linear_gains import chosen_otherwise
from fhaosmo_ros.tools.tuning.search import finished
from fhaosmo_ros.tools.tuning.tuner import simulated, TUNE_PARAMETERS, Tuner
import numpy as np

SMALL_CORRELATION, UNLIKELY = 0.05, 0.01
BOTH = ParameterTable(TUNE_PARAMETERS.declared, ESTIMATOR_PARAMETERS.declared)
Found = tuple[dict[str, Any], str]
"""Parameters of the estimator, and a report of them."""


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
    add('--channel', default='', metavar='NAME', help="for this one of a node's channels")
    add = parser.add_argument_group('from simulated recordings').add_argument
    add(
        '--trials', type=int, default=1000, metavar='N',
        help='that the study shall hold at the end (default: %(default)s)',
    )  # fmt: skip
    cores = os.cpu_count() or 1
    add(
        '--jobs', type=int, default=cores, metavar='N',
        help='trials at a time (default: one a core, %(default)s)',
    )  # fmt: skip
    add('--seed', type=int, default=1, help='of recordings and search (default: %(default)s)')
    add(
        '--storage', metavar='URL',
        help='data base of an Optuna study that several tune share, and that can be continued: '
        'sqlite:///study.db, postgresql+psycopg://... (default: in memory)',
    )  # fmt: skip
    return run_command(parser, argv, _tune)


def _tune(arguments: argparse.Namespace, stop: Stop) -> None:
    if arguments.trials < 1 or arguments.jobs < 1 or arguments.seed < 0:
        raise ConfigurationError(
            'expected --trials >= 1, --jobs >= 1 and --seed >= 0, got '
            f'{arguments.trials}, {arguments.jobs} and {arguments.seed}'
        )
    estimator, tuning = read_parameters(
        arguments.params_file, arguments.param, arguments.channel, arguments.bag is not None
    )
    inputs = [arguments.bag] if arguments.bag else []
    with output_at(arguments.output, arguments.force, *inputs) as folder:
        if arguments.bag:
            with stop.raising():
                parameters, text = _of_bag(arguments.bag, estimator, tuning)
        else:
            parameters, text = _of_search(arguments, estimator, tuning, stop)
        folder.mkdir()
        head = f'    python -m fhaosmo_ros {arguments.command_line}\n\n(fhaosmo_ros {__version__})'
        page = f'{head}\n\n{text}\n'
        (folder / 'report.md').write_text(f'# Tuning\n\n{page}', 'utf-8')
        comment = ''.join(f'# {line}'.rstrip() + '\n' for line in page.splitlines())
        (folder / 'gains.yaml').write_text(comment + dumps(parameters), 'utf-8')
    gains = arguments.output / 'gains.yaml'
    print(f'\n{text}\n\noutput: {gains}, report.md')
    print(f'use it: ros2 run fhaosmo_ros estimator --ros-args --params-file {gains}')


def read_parameters(
    files: list[Path], rules: list[str], channel: str = '', of_one: bool = False
) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Return what files and rules set for the estimator, and for the tuning.

    They are those of a `channel` if there is one to choose: `of_one` is meant, or some channel has
    values of its own. The gains are fixed ones, also where the estimator tunes itself.
    """
    found = [load(path, 'estimator') for path in files]
    given = BOTH.coerce(values_of(rules))
    parts = [*found, ESTIMATOR_PARAMETERS.part_of(given)]
    values = with_joints({name: value for part in parts for name, value in part.items()})
    if channel or of_one or any(split(name)[0] for name in values):
        channel, own = of_named_channel(values, channel, '--channel', given)
        its_own = {name.removeprefix(f'{channel}.') for name in values}
        values = {name: value for name, value in own.items() if name in its_own}
        if channel:
            values['channels'] = [channel]
    tuning: dict[str, Any] = {}
    prefix = f'{channel}.'
    for path, of_file in zip(files, found, strict=True):
        # Where only the estimator has a model, the plant has the same one; and so the sensor.
        own = {k.removeprefix(prefix): v for k, v in of_file.items() if k.startswith(prefix)}
        tuning |= ParameterTable(MODEL, SENSOR).part_of(of_file | own)
        tuning |= load(path, 'plant', TUNE_PARAMETERS) | load(path, 'tune', TUNE_PARAMETERS)
    return values | {'gains': 'fixed'}, tuning | TUNE_PARAMETERS.part_of(given)


def _of_search(
    arguments: argparse.Namespace, estimator: dict[str, Any], tuning: dict[str, Any], stop: Stop
) -> Found:
    """Search gains for a simulated family of recordings."""
    values = TUNE_PARAMETERS.complete(tuning)
    with stop.raising():
        training, held_out = simulated(values, arguments.seed)
        print(f'{len(training)} recordings to train on, {len(held_out)} held out')
        tuner = Tuner(training, estimator, values, arguments.seed)
    study = tuner.search(arguments.trials, arguments.jobs, arguments.storage, stop.is_set)
    start = tuner.parameters({d.name: d.start for d in tuner.space})
    tuned = tuner.parameters(study.best_params)
    columns, found = [''], []
    for title, parameters in (('start', start), ('tuned', tuned)):
        columns += [f'{title}, training', f'{title}, held out']
        found += [tuner.objective(parameters), tuner.objective(parameters, held_out)]
    rows = [['error, relative to the truth', *(f'{error:.4f}' for error, _ in found)]]
    names = [*(f'z{k}' for k in range(1, len(tuner.objective.scale))), 'd']
    for name, of_name in zip(names, zip(*(rms(e) for _, e in found), strict=True), strict=True):
        rows.append([f'RMS error of {name}', *(f'{error:.3g}' for error in of_name)])
    text = (
        f'{finished(study)} trials on {len(training)} simulated recordings; '
        f'{len(held_out)} others, held out, took no part in the search.\n\n'
        f'{markdown(columns, rows)}'
    )
    if not values['noise_std'] and not values['quantisation']:
        text += '\n\nNote: these gains are for a y without noise. If yours has some, say by '
        text += 'noise_std how large (its standard deviation), and tune again.'
    return tuned, text


def _of_bag(path: Path, estimator: dict[str, Any], tuning: dict[str, Any]) -> Found:
    """Find the gains for what the y of a bag shows."""
    (channel,) = estimator.get('channels', [''])
    if others := chosen_otherwise(estimator):
        raise ConfigurationError(
            f'--bag: expected gains of structure levant, got {", ".join(others)} set. Leave that '
            'out; or tune by a simulated family: without --bag, with noise_std, rms_of_d and '
            'band_of_d as this command finds them'
        )
    given = ParameterTable(MODEL).part_of(tuning) | estimator
    values = ESTIMATOR_PARAMETERS.complete(given)
    given |= {name: values[name] for name in ('order', 'phi')}
    with BagReader(path) as reader:
        inputs = BagInputs(reader, values, TriangularModel.of(values), channel=channel)
        samples, field = inputs.samples()
        if field.wraps:
            samples = samples.unwrapped()
        u = inputs.at(samples)
    t = (samples.stamps - samples.stamps[0]) * 1e-9
    found = Identification((t, samples.values, u), values, given)
    best, (parameters, expected) = found.best, found.gains()
    size, white = found.size_of_input(best.design, best.noise), found.whiteness()
    seconds, share = found.samples.h.sum(), expected[-1] / size
    rows = [
        (f'samples in {path.resolve().name}', f'{len(found.samples.y)} in {seconds:.1f} s'),
        ('noise of y (standard deviation)', f'{best.noise:.4g}' + ' (given)' * found.fixed),
        ('size of d (RMS)', f'{size:.4g}'),
        ('time in which d changes (1/kappa), s', f'{1.0 / best.design.decay:.4g}'),
        ('derivatives of d that are followed', f'{best.design.derivatives}'),
        *((f'expected error of z{i}', f'{x:.3g}') for i, x in enumerate(expected[:-1], 1)),
        ('expected error of d', f'{expected[-1]:.3g} ({share:.2f} of its size)'),
        ('probability that innovations are white (Ljung-Box)', f'{white[1]:.2g}'),
    ]
    told = [f'Note: {text}' for text in notes(found, *white)]
    text = '\n\n'.join([markdown(['found in y', ''], rows), *told])
    return ESTIMATOR_PARAMETERS.part_of(parameters), text


def notes(found: Identification, correlation: float, probability: float) -> Iterator[str]:
    """Say what a user should know before trusting the gains."""
    samples, model, whole = found.samples, found.model, float(found.samples.h.sum())
    if found.quantum > 2.0 * found.best.noise:
        yield (
            f'y comes in steps of {found.quantum:.3g}, larger than its noise: the '
            'error of the steps is not random. `gains: self_tuning` knows of steps.'
        )
    if found.outliers:
        yield (
            f'{found.outliers} samples ({found.outliers / len(samples.y):.2%}) are outliers. They '
            'were left out; the estimator rejects such samples, too.'
        )
    rates = model.slopes_at_rest + np.eye(model.order, k=1)
    growth = float(np.linalg.eigvals(rates).real.max())
    if growth * whole > SURE:
        yield (
            f'The model is unstable: at rest, without d, it grows tenfold within '
            f'{math.log(10.0) / growth:.2g} s, but y has stayed within {samples.y.min():.3g} and '
            f'{samples.y.max():.3g} for {whole:.0f} s. If no controller holds this plant, then a '
            'sign in phi is wrong; if one does, its command should be a known input, or d '
            'contains it.'
        )
    if probability < UNLIKELY and abs(correlation) > SMALL_CORRELATION:
        yield (
            f'Innovations are not white: they correlate by {correlation:+.2f} with earlier '
            'ones. The model of the plant, of d or of the noise does not quite fit; the gains are '
            'the best of their kind, but standard deviations are too small. '
            '`gains: self_tuning` follows noise that is coloured.'
        )


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)
