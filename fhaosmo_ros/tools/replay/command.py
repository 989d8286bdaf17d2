# SPDX-License-Identifier: Apache-2.0
"""Replay a recorded y through the node's update path, as fast as the machine allows."""

import argparse
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from time import perf_counter

from fhaosmo_ros.core.observer.estimates import Trajectory
from fhaosmo_ros.core.observer.status import UNUSED
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import Event
from fhaosmo_ros.core.parameters.declaration import ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import CHANNEL_PARAMETERS, INPUT, ONLINE_PARAMETERS
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.inputs import BagInputs
from fhaosmo_ros.tools.bags.reader import BagReader, FieldSamples
from fhaosmo_ros.tools.bags.table import bag_of_table
from fhaosmo_ros.tools.bags.topics import Recorded, recorded_parameters
from fhaosmo_ros.tools.cli.command import Output, run_command
from fhaosmo_ros.tools.cli.options import (
    add_parameter_options,
    channel_parameters,
    named,
)
from fhaosmo_ros.tools.replay.live_run import find_estimator, LiveRun, UnknownSnapshot
from fhaosmo_ros.tools.replay.sinks import bag_sink, Rows, TABLES
from fhaosmo_ros.topics import ESTIMATES
import numpy as np
from numpy.typing import NDArray

BLOCK = 16_384
"""Samples that are estimated, and written, at a time."""
NONE = np.zeros(0, dtype=np.int64)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if the output is complete, else there is none."""
    parser = argparse.ArgumentParser(
        prog='replay',
        description='Estimate offline from a recorded bag, with the result of the live node.',
    )
    add = parser.add_argument
    add('bag', type=Path, help='folder of a bag, or its .mcap or .db3 file; or a .csv file')
    add(
        '--columns', metavar='T,Y,U', default='',
        help='titles in a .csv file of the time in seconds, of y and of the known inputs '
        '(default: the first columns)',
    )  # fmt: skip
    add(
        '-o', '--output', type=Path, action='append', metavar='PATH',
        help='.csv, .npz, or else a new bag; may be given several times '
        '(default: a bag BAG_replayed in the current folder)',
    )  # fmt: skip
    add('--force', action='store_true', help='replace an output that exists')
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument(
        '--follow', metavar='NAME',
        help='live estimator whose first sample, resets and live changes to repeat (default: the '
        'one whose ~/snapshot the bag holds)',
    )  # fmt: skip
    choice.add_argument(
        '--afresh', action='store_true', help='begin at the first sample, follow no live estimator'
    )
    add(
        '--smooth', action='store_true',
        help='estimate each time from the samples before and after it; needs noise_size (for '
        'those until some time after it: -p smoothing_lag:=SECONDS)',
    )  # fmt: skip
    add(
        '--name', metavar='NAME',
        help='put before the topics of the estimates (default: /estimator, or /replay/estimator '
        'where the bag already holds estimates)',
    )  # fmt: skip
    add_parameter_options(parser)
    return run_command(parser, argv, _replay)


def _replay(arguments: argparse.Namespace, stop: Stop) -> None:
    is_table = arguments.bag.suffix == '.csv'
    if arguments.columns and not is_table:
        raise ConfigurationError(f'--columns: expected a .csv file, got {arguments.bag}')
    bag_name = arguments.bag.resolve().name.removesuffix('.csv' if is_table else '.mcap')
    begin = perf_counter()
    with ExitStack() as stack:
        path = arguments.bag
        if is_table:
            path = Path(stack.enter_context(TemporaryDirectory()), 'table')
            own = channel_parameters(arguments)
            used = OnlineEstimator(ONLINE_PARAMETERS.part_of(own)).observer.used_inputs
            titles = [title.strip() for title in arguments.columns.split(',') if title.strip()]
            bag_of_table(arguments.bag, titles, used, path)
        reader = stack.enter_context(BagReader(path))
        followed = recorded = live = None
        if not arguments.afresh:
            followed = find_estimator(reader, arguments.follow, arguments.channel)
        if not arguments.params_file:
            recorded = recorded_parameters(reader, followed)
        if recorded:
            arguments.channel = arguments.channel or recorded.channel
        own = channel_parameters(arguments, recorded)
        if is_table:
            # The file says where y and u are, not the topics of a node.
            own = {k: v for k, v in own.items() if k not in ParameterTable(INPUT)}
        if arguments.smooth:
            own['smoothing_lag'] = 0.0
        estimator = OnlineEstimator(ONLINE_PARAMETERS.part_of(own))
        if arguments.smooth:
            estimator.smooth()
        if followed is not None:
            try:
                live = LiveRun(reader, followed, estimator, named(arguments))
            except UnknownSnapshot as error:
                _warn(f'{error}; {followed} is not followed, this begins at the first sample')
        namespace = recorded.namespace if recorded else arguments.node.rpartition('/')[0]
        values, model = CHANNEL_PARAMETERS.defaults() | own, estimator.observer.model
        inputs = BagInputs(reader, values, model, namespace, arguments.channel)
        finals = arguments.output or [Path(f'{bag_name}_replayed')]
        outputs = [stack.enter_context(Output(path, arguments.force)) for path in finals]
        name = _name({c.topic for c in reader.connections}, arguments.name)
        with stop.raising(), ExitStack() as files:
            samples, field = inputs.samples()
            span = float(samples.stamps[-1] - samples.stamps[0]) * 1e-9
            stamps = 'source (publish times of the bag)'
            if np.array_equal(samples.stamps, samples.times):
                stamps = 'bag'
            elif field.header and inputs.y.stamp != 'source':
                stamps = 'header of the messages'
            if live:
                samples = live.begin(samples)
            if field.wraps:
                latest = estimator.state_dict()['y'] + estimator.offset
                samples = samples.unwrapped(None if estimator.latest is None else latest)
            u = None
            if estimator.observer.used_inputs:
                u = inputs.at(samples, estimator.inputs, estimator.reject_inputs)
            parameters = ONLINE_PARAMETERS.defaults() | own
            sinks = [
                files.enter_context(
                    TABLES[o.path.suffix](o.path)
                    if o.path.suffix in TABLES
                    else bag_sink(o.path, reader, name, estimator.observer, parameters)
                )
                for o in outputs
            ]
            for rows in _estimates(estimator, live, samples, u, arguments.smooth):
                for sink in sinks:
                    sink(rows)
        finals = [output.keep() for output in outputs]
    seconds = perf_counter() - begin
    c = estimator.counters
    print(
        f'{c.accepted} samples used, {c.rejected} rejected, {c.restarts} restarts; '
        f'{span:.1f} s of data in {seconds:.2f} s'
    )
    for why, count in reader.lacking.items():
        print(f'{count} messages left out: {why}')
    if estimator.smoothing is not None:
        lag = estimator.parameters['smoothing_lag']
        later = 'and after' if arguments.smooth else f'and until {lag:g} s after'
        print(f'smoothed: each estimate by the samples before {later} it')
    print(f'stamps: {stamps}')
    print(f'parameters: {_origin(arguments, recorded)}')
    if not arguments.params_file and not recorded:
        _warn(
            'the bag has no ~/parameters to take, so the defaults are used; '
            "--params-file gives the node's own"
        )
    if live:
        print(live.report())
    if reader.unchecked:
        print('the bag has no checksums: damage to its numbers would not be noticed')
    for final in finals:
        where = '' if final.suffix in TABLES else f' (estimates: {name}/...)'
        print(f'output: {final}{where}')


def _estimates(
    estimator: OnlineEstimator,
    live: LiveRun | None,
    samples: FieldSamples,
    u: NDArray[np.float64] | None,
    whole: bool,
) -> Iterator[Rows]:
    """Yield estimates block by block; `whole`: smoothed over the whole recording."""
    events: list[tuple[int, Event]] = []
    lasting = 0  # 1 while an event lasts

    def due(found: Trajectory) -> Rows:
        """Return the rows whose smoothed estimates are final."""
        smoothing = estimator.smoothing
        numbers = np.zeros(0, dtype=np.int64) if smoothing is None else smoothing.numbers
        return Rows(samples.times[numbers], samples.values[numbers], found, NONE, events)

    parts = live.parts(samples.stamps) if live else [slice(0, len(samples.stamps))]
    for part in parts:
        for begin in range(part.start, part.stop, BLOCK):
            block = slice(begin, min(begin + BLOCK, part.stop))
            times, stamps, y = samples.part(block)
            found = estimator.run(stamps, y, None if u is None else u[block])
            active = lasting + np.zeros(len(times), dtype=np.int64)
            for event in estimator.events.taken():
                lasting = int(event.begins)
                active[event.sample :] = lasting
                events.append((int(times[event.sample]), event))
            if estimator.smoothing is not None:
                rows = due(found)
            else:
                keep = np.flatnonzero((found.status & UNUSED) == 0)
                active = active[keep] if estimator.events.on else NONE
                rows = Rows(times[keep], y[keep], found.rows(keep), active, events)
            if len(rows.times):
                yield rows
                events = []
    if whole and len((rows := due(estimator.finish())).times):
        yield rows


def _warn(text: str) -> None:
    print(f'replay: warning: {text}', file=sys.stderr)


def _origin(arguments: argparse.Namespace, recorded: Recorded | None) -> str:
    if arguments.params_file:
        base = ', '.join(map(str, arguments.params_file))
    elif recorded:
        base = f'{recorded.topic} in the bag'
    else:
        base = 'the defaults'
    own = named(arguments)
    return base + (f', with {", ".join(own)} of the command line' if own else '')


def _name(present: set[str], name: str | None) -> str:
    """Return the name below which the estimates' topics go."""
    for candidate in [f'/{name.strip("/")}'] if name else ['/estimator', '/replay/estimator']:
        taken = present & {f'{candidate}/{part}' for part in ESTIMATES}
        if not taken:
            return candidate
    raise ConfigurationError(f'--name: expected topics that the bag lacks, got {min(taken)!r}')
