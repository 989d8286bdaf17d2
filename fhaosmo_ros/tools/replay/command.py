# SPDX-License-Identifier: Apache-2.0
"""Replay a recorded y through the node's update path, as fast as the machine allows."""

import argparse
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from fhaosmo_ros.core.observer.estimates import Trajectory
from fhaosmo_ros.core.observer.status import UNUSED
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import Event
from fhaosmo_ros.core.parameters.declaration import Parameters, ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import read, with_origin
from fhaosmo_ros.core.parameters.per_channel import of_named_channel, select
from fhaosmo_ros.core.parameters.tables import (
    CHANNEL_PARAMETERS,
    ESTIMATOR_PARAMETERS,
    INPUT,
    ONLINE_PARAMETERS,
)
from fhaosmo_ros.inputs import with_joints
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.reader import BagReader, Samples
from fhaosmo_ros.tools.bags.recorded import BagInputs, Recorded, recorded_parameters
from fhaosmo_ros.tools.bags.table import bag_of_table
from fhaosmo_ros.tools.cli.command import add_value_options, output_at, run_command, values_of
from fhaosmo_ros.tools.replay.live_run import find_estimator, LiveRun
from fhaosmo_ros.tools.replay.sinks import bag_sink, Rows, TABLES
from fhaosmo_ros.topics import ESTIMATES, TOPIC_NAME
import numpy as np
from numpy.typing import NDArray

BLOCK = 16_384
"""Samples that are estimated, and written, at a time."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if the output is complete, else there is none."""
    return run_command(options(), argv, _replay)


def options() -> argparse.ArgumentParser:
    """Return the parser of the command's arguments."""
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
    add(
        '--afresh', action='store_true',
        help='begin at the first sample; else begin, reset and change parameters where the live '
        'estimator whose ~/snapshot the bag holds did',
    )  # fmt: skip
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
    add_value_options(
        parser, "parameters of the estimator node, as in 'ros2 run' (default: those in the bag)"
    )
    add(
        '--node', default='estimator', metavar='NAME',
        help='whose sections of the files to take, and which of several live estimators to '
        'follow, such as /rig/estimator (default: %(default)s)',
    )  # fmt: skip
    add(
        '--channel', default='', metavar='NAME',
        help="the same: of this one of the node's channels",
    )  # fmt: skip
    return parser


def make_estimator(
    arguments: argparse.Namespace, recorded: Recorded | None = None
) -> tuple[Parameters, OnlineEstimator]:
    """
    Return a channel's parameters, and the estimator that has them.

    They are those `recorded`, changed by files, and these by -p.
    """
    given: list[tuple[Any, dict[str, Any]]] = []
    if recorded:
        given.append((f'topic {recorded.topic!r}', recorded.values))
    given += [(path, read(path, arguments.node, strict=True)) for path in arguments.params_file]
    values: dict[str, Any] = {}
    origins: dict[str, Any] = {}
    rules = values_of(arguments.param)
    for origin, found in [*given, (None, rules)]:
        values |= found
        origins |= dict.fromkeys(found, origin)
    try:
        values = select(values, ESTIMATOR_PARAMETERS)
    except ConfigurationError as error:
        raise with_origin(error, origins) from None
    values = with_joints(values)
    channel, own = of_named_channel(values, arguments.channel, '--channel', rules)
    arguments.channel, parameters = channel, CHANNEL_PARAMETERS.complete(own)
    if arguments.bag.suffix == '.csv':  # it says where y and u are, not the topics of a node
        parameters = parameters.changed(ParameterTable(INPUT).defaults())
    if arguments.smooth:
        parameters = parameters.changed({'smoothing_lag': 0.0})
    try:
        estimator = OnlineEstimator(parameters)
    except ConfigurationError as error:
        raise with_origin(error, origins, channel) from None
    if arguments.smooth:
        estimator.smooth()
    return parameters, estimator


def _replay(arguments: argparse.Namespace, stop: Stop) -> None:
    path, is_table = arguments.bag, arguments.bag.suffix == '.csv'
    if arguments.columns and not is_table:
        raise ConfigurationError(f'--columns: expected a .csv file, got {path}')
    bag_name = path.resolve().name.removesuffix('.csv' if is_table else '.mcap')
    started = perf_counter()
    with ExitStack() as stack:
        if is_table:
            path = Path(stack.enter_context(TemporaryDirectory()), 'table')
            _, estimator = make_estimator(arguments)
            used = estimator.observer.used_inputs
            bag_of_table(arguments.bag, arguments.columns, used, path)
        reader = stack.enter_context(BagReader(path))
        followed = recorded = live = None
        if not arguments.afresh:
            followed = find_estimator(reader, arguments.node, arguments.channel)
        if not arguments.params_file:
            recorded = recorded_parameters(reader, followed)
        if recorded:
            arguments.channel = arguments.channel or recorded.channel
        values, estimator = make_estimator(arguments, recorded)
        named = [name.removeprefix(f'{arguments.channel}.') for name in values_of(arguments.param)]
        named = [name for name in named if name in ONLINE_PARAMETERS]
        if followed is not None:
            live = LiveRun(reader, followed, estimator, named)
        node = recorded.topic.rpartition('/')[0] if recorded else arguments.node
        namespace, model = node.rpartition('/')[0], estimator.observer.model
        inputs = BagInputs(reader, values, model, namespace, arguments.channel)
        finals = [*dict.fromkeys(arguments.output or [Path(f'{bag_name}_replayed')])]
        outputs = [
            stack.enter_context(output_at(final, arguments.force, arguments.bag))
            for final in finals
        ]
        name = _name({c.topic for c in reader.connections}, arguments.name)
        with stop.raising(), ExitStack() as files:
            samples, field = inputs.samples()
            begin = int(samples.times[0])
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
            u = inputs.at(samples, estimator.inputs) if model.used_inputs else None
            of_bag = reader, name, estimator.observer, values, begin
            sinks = [
                files.enter_context(TABLES.get(path.suffix, bag_sink)(path, *of_bag))
                for path in outputs
            ]
            for rows in _estimates(estimator, live, samples, u, arguments.smooth):
                for write in sinks:
                    write(rows)
            c = estimator.counters
            counts = {name: n for name, n in c._asdict().items() if n and name != 'accepted'}
            told = ', '.join(f'{name} {n}' for name, n in counts.items())
            if c.rejected and not c.accepted:
                raise ConfigurationError(
                    f'topic {inputs.y.topic!r}: expected samples that can be used, got {told}'
                )
    print(
        f'{c.accepted} samples used, {c.rejected} rejected, {c.restarts} restarts; '
        f'{span:.1f} s of data in {perf_counter() - started:.2f} s'
    )
    if told:
        print(f'counters: {told}')
    for why, count in reader.lacking.items():
        print(f'{count} messages left out: {why}')
    print(f'stamps: {stamps}')
    origin = f'{recorded.topic} in the bag' if recorded else 'the defaults'
    if arguments.params_file:
        origin = ', '.join(map(str, arguments.params_file))
    elif not recorded:
        print(
            'replay: warning: the bag has no ~/parameters to take, so the defaults are used; '
            "--params-file gives the node's own", file=sys.stderr,
        )  # fmt: skip
    changes = f', with {", ".join(named)} of the command line' if named else ''
    print(f'parameters: {origin}{changes}')
    if live:
        print(live.report())
    for final in finals:
        where = '' if final.suffix in TABLES else f' (estimates: {name}/...)'
        print(f'output: {final}{where}')


def _estimates(
    estimator: OnlineEstimator,
    live: LiveRun | None,
    samples: Samples,
    u: NDArray[np.float64] | None,
    whole: bool,
) -> Iterator[Rows]:
    """Yield estimates block by block; `whole`: smoothed over the whole recording."""
    events: list[tuple[int, Event]] = []
    active = np.zeros(len(samples.times), dtype=np.int8)  # 1 while an event lasts

    def rows(numbers: NDArray[np.int64], found: Trajectory) -> Iterator[Rows]:
        if len(numbers):
            lasting = active[numbers] if estimator.events.on else active[:0]
            yield Rows(samples.times[numbers], samples.values[numbers], found, lasting, events)
            events.clear()

    parts = live.parts(samples.stamps) if live else [slice(0, len(samples.stamps))]
    for part in parts:
        for begin in range(part.start, part.stop, BLOCK):
            times, stamps, y = samples.part(slice(begin, min(begin + BLOCK, part.stop)))
            found = estimator.run(stamps, y, None if u is None else u[begin : begin + len(y)])
            for event in estimator.events.taken():
                active[begin + event.sample :] = event.begins
                events.append((int(times[event.sample]), event))
            if estimator.smoothing is not None:  # those that are final
                yield from rows(estimator.smoothing.numbers, found)
            else:
                keep = np.flatnonzero((found.status & UNUSED) == 0)
                yield from rows(begin + keep, found.rows(keep))
    if whole:
        found = estimator.finish()
        assert estimator.smoothing is not None
        yield from rows(estimator.smoothing.numbers, found)


def _name(present: set[str], name: str | None) -> str:
    """Return the name below which the estimates' topics go."""
    if name and not TOPIC_NAME.fullmatch(name.rstrip('/')):
        raise ConfigurationError(f'--name: expected a name such as /tuned, got {name!r}')
    for candidate in [f'/{name.strip("/")}'] if name else ['/estimator', '/replay/estimator']:
        taken = present & {f'{candidate}/{part}' for part in ESTIMATES}
        if not taken:
            return candidate
    raise ConfigurationError(f'--name: expected topics that the bag lacks, got {min(taken)!r}')
