# SPDX-License-Identifier: Apache-2.0
"""Replay a recorded y through the node's update path, as fast as the machine allows."""

import argparse
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
import sys
from time import perf_counter

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.status import REJECTED
from fhaosmo_ros.stop_signals import Stop, stop_on_signals
from fhaosmo_ros.tools.bag_copy import copy_topics
from fhaosmo_ros.tools.bag_reader import BagReader, Block
from fhaosmo_ros.tools.bags import BagWriter
from fhaosmo_ros.tools.held_input import HeldInput
from fhaosmo_ros.tools.options import add_parameter_options, online_parameters
from fhaosmo_ros.tools.output import Output
from fhaosmo_ros.tools.sinks import BagSink, CsvSink, NpzSink, Rows, Sink, TOPICS
import numpy as np
from tqdm import tqdm


class Interrupted(Exception):
    """The user asked to stop; nothing is kept."""


def main(argv: list[str] | None = None) -> int:
    """
    Run the command.

    Returns
    -------
    int
        0 if the output is complete, 130 after Ctrl-C, 2 for wrong input; then there is none.

    """
    arguments = _parser().parse_args(argv)
    stop = stop_on_signals()
    try:
        _replay(arguments, stop)
    except ConfigurationError as error:
        print(f'replay: error: {error}', file=sys.stderr)
        return 2
    except OSError as error:
        print(f'replay: error: output: {error.strerror}: {error.filename}', file=sys.stderr)
        return 1
    except Interrupted:
        print('replay: interrupted, nothing written', file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='replay',
        description='Estimate offline from a recorded bag, with the result of the live node.',
    )
    add = parser.add_argument
    add('bag', type=Path, help='folder of a bag, or its .mcap or .db3 file')
    add(
        '-o', '--output', type=Path, action='append', metavar='PATH',
        help='.csv, .npz, or else a new bag; may be given several times '
        '(default: a bag BAG_replayed in the current folder)',
    )  # fmt: skip
    add('--force', action='store_true', help='replace an output that exists')
    add('--storage', choices=('mcap', 'sqlite3'), default='mcap', help='of a bag (%(default)s)')
    add('--topic', default='/y', help='topic of the measured output (%(default)s)')
    add('--field', help="number in its messages, such as 'position[2]' (default: the only one)")
    add('--input-topic', default='/u', help='topic of the known input (%(default)s)')
    add('--input-field', help='number in its messages')
    add(
        '--stamp', choices=('auto', 'header', 'bag'), default='auto',
        help='where dt comes from; auto: the header where the messages have one, else the bag',
    )  # fmt: skip
    add(
        '--backwards', choices=('error', 'reject'), default='error',
        help='what to do with stamps that go back; reject: as the live node does (%(default)s)',
    )  # fmt: skip
    add('--every', type=int, default=1, metavar='N', help='keep every N-th estimate only')
    add(
        '--name', metavar='NAME',
        help='put before the topics of the estimates (default: /estimator, or /replay/estimator '
        'where the bag already holds estimates)',
    )  # fmt: skip
    add_parameter_options(parser)
    return parser


def _replay(arguments: argparse.Namespace, stop: Stop) -> None:
    if arguments.every < 1:
        raise ConfigurationError(f'--every: expected an integer >= 1, got {arguments.every}')
    estimator = OnlineEstimator(online_parameters(arguments))
    default = Path(f'{arguments.bag.resolve().name.removesuffix(".mcap")}_replayed')
    finals = arguments.output or [default]
    begin = perf_counter()
    with ExitStack() as stack:
        reader = stack.enter_context(BagReader(arguments.bag))
        samples = Samples(reader, estimator, arguments)
        outputs = [stack.enter_context(Output(path, arguments.force)) for path in finals]
        name = _name(reader, arguments.name)
        _write(reader, samples, outputs, name, arguments, stop)
        finals = [output.keep() for output in outputs]
    seconds = perf_counter() - begin
    c = estimator.counters
    print(
        f'{c.accepted} samples used, {c.rejected} rejected, {c.restarts} restarts; '
        f'{samples.span:.1f} s of data in {seconds:.2f} s'
    )
    for final in finals:
        where = '' if final.suffix in ('.csv', '.npz') else f' (estimates: {name}/...)'
        print(f'output: {final}{where}')


class Samples:
    """The estimates of a bag's samples, block by block."""

    def __init__(
        self, reader: BagReader, estimator: OnlineEstimator, arguments: argparse.Namespace
    ) -> None:
        topic = arguments.topic
        self.estimator, self.topic = estimator, topic
        self._reader, self._backwards = reader, arguments.backwards == 'error'
        self._every, self._seen, self._taken = arguments.every, 0, 0
        self._field = reader.field(topic, arguments.field)
        self._use_header = self._field.has_header and arguments.stamp != 'bag'
        if arguments.stamp == 'header' and not self._field.has_header:
            raise ConfigurationError(
                f'--stamp header: expected messages with a header on {topic}, '
                f'got {reader.message_type(topic)}'
            )
        self._input = None
        if estimator.observer.uses_input:
            self._input = HeldInput(
                reader, arguments.input_topic, arguments.input_field, estimator.reject_inputs
            )
        self._first: int | None = None
        self._latest: int | None = None

    @property
    def total(self) -> int:
        """Number of samples in the bag."""
        return self._reader.count(self.topic)

    @property
    def span(self) -> float:
        """Seconds from the first sample to the latest."""
        return 0.0 if self._first is None else (self._latest - self._first) * 1e-9

    def __iter__(self) -> Iterator[tuple[int, list[Rows]]]:
        """Yield the number of samples taken, and their estimates."""
        for block in self._reader.blocks(self.topic, self._field, self._use_header):
            if not len(block.times):
                continue
            self._check(block)
            u = self._input(block.times) if self._input else np.zeros(len(block.times))
            yield len(block.times), list(self._rows(block, u))
        if not self._taken:
            raise ConfigurationError(
                f'topic {self.topic!r}: expected messages, read none although the bag lists them'
            )

    def _check(self, block: Block) -> None:
        stamps = block.stamps
        if self._first is None:
            self._first = self._latest = int(stamps[0])
        previous = np.concatenate([[self._latest], stamps[:-1]])
        back = np.flatnonzero(stamps < previous)
        if len(back) and self._backwards and self.estimator.uses_stamps:
            k = int(back[0])
            raise ConfigurationError(
                f'topic {self.topic!r}: expected stamps that never go back, got {stamps[k]} '
                f'after {previous[k]} (sample {self._taken + k + 1}); --backwards reject treats '
                'them as the live node does'
            )
        self._latest = int(stamps[-1])
        self._taken += len(stamps)

    def _rows(self, block: Block, u: np.ndarray) -> Iterator[Rows]:
        estimates = self.estimator.run(block.stamps, block.values, u)
        keep = np.flatnonzero((estimates.status & REJECTED) == 0)
        count = len(keep)
        keep = keep[(self._every - 1 - self._seen) % self._every :: self._every]
        self._seen += count
        if len(keep):
            if len(keep) < len(block.times):
                estimates = type(estimates)(*(a[keep] for a in estimates))
            yield Rows(block.times[keep], block.values[keep], estimates)


def _name(reader: BagReader, name: str | None) -> str:
    """Return what stands before the topics of the estimates."""
    present = {c.topic for c in reader.connections}
    for candidate in [name.rstrip('/')] if name else ['/estimator', '/replay/estimator']:
        taken = [f'{candidate}/{topic}' for topic in TOPICS if f'{candidate}/{topic}' in present]
        if not taken:
            return candidate if candidate.startswith('/') else f'/{candidate}'
    raise ConfigurationError(f'--name: expected topics that the bag lacks, got {taken[0]!r}')


def _write(
    reader: BagReader, samples: Samples, outputs: list[Output], name: str,
    arguments: argparse.Namespace, stop: Stop,
) -> None:  # fmt: skip
    observer = samples.estimator.observer
    with ExitStack() as stack:
        sinks: list[Sink] = []
        for output in outputs:
            if output.path.suffix == '.csv':
                sinks.append(CsvSink(output.path))
            elif output.path.suffix == '.npz':
                sinks.append(NpzSink(output.path))
            else:
                bag = stack.enter_context(BagWriter(output.path, storage=arguments.storage))
                sinks.append(BagSink(bag, name, observer.order, observer.levels))
                for _ in copy_topics(reader, bag):
                    _check_stop(stop)
        with tqdm(total=samples.total, unit='sample', unit_scale=True, desc='replay') as bar:
            for count, rows in samples:
                _check_stop(stop)
                for part in rows:
                    for sink in sinks:
                        sink.write(part)
                bar.update(count)
        for sink in sinks:
            sink.close()


def _check_stop(stop: Stop) -> None:
    if stop.is_set():
        raise Interrupted
