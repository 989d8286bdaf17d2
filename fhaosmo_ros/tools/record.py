# SPDX-License-Identifier: Apache-2.0
"""Record y and the estimator's topics to a bag."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue
import re
import shutil
import sys
import time
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.types import TYPES
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.cli.command import progress, run_command
from fhaosmo_ros.topics import OF_ALL_NODES
from tqdm import tqdm

FLUSH_PERIOD = 0.5
"""Seconds between two flushes: a kill loses no more than that."""
EXTRA = ('/y', '/u', *OF_ALL_NODES)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if there is a valid bag, 2 also if nothing was recorded."""
    return run_command(_parser(), argv, _record)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='record',
        description="Record y, the estimator's and the plant's topics to a bag until Ctrl-C.",
    )
    add = parser.add_argument
    add('-o', '--output', type=Path, metavar='BAG', help='new folder (default: bag_TIME)')
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument('--topics', nargs='+', metavar='TOPIC', help='these topics only')
    choice.add_argument('--all', action='store_true', help='every topic that has a publisher')
    add(
        '--names', nargs='+', default=['/estimator', '/plant'], metavar='NAME',
        help='nodes whose topics, in and out, to record (default: /estimator /plant)',
    )  # fmt: skip
    add('--duration', type=float, metavar='SECONDS', help='stop by itself')
    return parser


def _record(arguments: argparse.Namespace, stop: Stop) -> None:
    if arguments.duration is not None and not arguments.duration > 0.0:
        raise ConfigurationError(f'--duration: expected > 0 s, got {arguments.duration:g}')
    path = arguments.output or Path(time.strftime('bag_%Y-%m-%d_%H-%M-%S'))
    if path.exists():
        kind = 'folder' if path.is_dir() else 'file'
        raise ConfigurationError(f'output {path}: expected a new name, got an existing {kind}')
    for topic in arguments.topics or []:
        if not re.fullmatch(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', topic):
            raise ConfigurationError(f'--topics: expected a name such as /y, got {topic!r}')
    # Here, so that --help needs no ROS.
    from fhaosmo_ros.nodes.recording.topic_recorder import TopicRecorder

    queue: SimpleQueue = SimpleQueue()
    recorder = TopicRecorder(
        queue.put,
        wanted=lambda topic: wanted(topic),
        listeners=[] if arguments.topics else [_full(name) for name in arguments.names],
        ros_arguments=arguments.ros_arguments,
    )
    wanted = _wanted(arguments, recorder.resolved)  # by its node's remappings
    try:
        with BagWriter(path) as bag, recorder:
            # Says when it listens, so that a user knows when to start what is to be recorded.
            print(f'recording to {path}; Ctrl-C ends it', flush=True)
            count = _drain(queue, recorder.problems, bag, arguments.duration, stop)
            lost = dict(recorder.lost)
    except OSError as error:
        hint = '; `mcap recover` saves what was recorded' if path.exists() else ''
        raise ConfigurationError(
            f'output {path}: expected a place that can be written, got: '
            f'{error.strerror or error}{hint}'
        ) from None
    if not count:
        shutil.rmtree(path)
        raise ConfigurationError('nothing was published on these topics: no bag kept')
    for topic, number in sorted(lost.items()):
        print(
            f'record: {topic}: {number} messages were lost on their way here (a busy machine or '
            'network; a deeper queue of the publisher helps)',
            file=sys.stderr,
        )
    print(f'{count} messages: {path}')


def _full(name: str) -> str:
    return f'/{name.strip("/")}'


def _wanted(
    arguments: argparse.Namespace, resolved: Callable[[str], str]
) -> Callable[[str], bool]:
    """Return a function that says of a topic whether to record it."""
    if arguments.all:
        return lambda topic: True
    if arguments.topics:
        names = {resolved(_full(topic)) for topic in arguments.topics}
        return lambda topic: topic in names
    return topics_of([_full(name) for name in arguments.names], resolved)


def topics_of(
    names: Sequence[str], resolved: Callable[[str], str] = lambda name: name
) -> Callable[[str], bool]:
    """
    Return a function that says of a topic whether it is of one of these nodes, or of all nodes.

    Parameters
    ----------
    names : sequence of str
        Full names of nodes.
    resolved : callable, optional
        Returns a name after remapping.

    """
    below = tuple(f'{resolved(name)}/' for name in names)
    extra = [resolved(topic) for topic in EXTRA]
    return lambda topic: topic.startswith(below) or topic in extra


def store(bag: BagWriter, item: Any) -> bool:
    """Write what a recorder hands over, a topic or a sample; return True for a sample."""
    if not hasattr(item, 'offered'):
        bag.write(item.topic, item.stamp, item.data)
        return True
    offered = item.offered
    different = [qos for k, qos in enumerate(offered) if qos not in offered[:k]]
    bag.add(item.topic, item.message_type, qos=different)
    if item.message_type not in TYPES.fielddefs:
        tqdm.write(f'{item.topic}: the bag will lack the definition of its type')
    return False


def _drain(
    queue: SimpleQueue,
    problems: SimpleQueue,
    bag: BagWriter,
    duration: float | None,
    stop: Stop,
) -> int:
    """Write what arrives until the end; return how many messages there were."""
    begin = flushed = time.monotonic()
    count, ended = 0, False
    bar_format = '{desc}: {n_fmt} messages, {elapsed}'
    with progress(desc='record', unit='message', bar_format=bar_format) as bar:
        while not ended:
            ended = stop.wait(0.05) or (
                duration is not None and time.monotonic() - begin >= duration
            )
            for _ in range(queue.qsize()):
                count += store(bag, queue.get())
            while not problems.empty():
                tqdm.write(f'record: not recorded: {problems.get()}', file=sys.stderr)
            if time.monotonic() - flushed >= FLUSH_PERIOD:
                bag.flush()
                flushed = time.monotonic()
            bar.update(count - bar.n)
    return count
