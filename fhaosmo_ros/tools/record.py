# SPDX-License-Identifier: Apache-2.0
"""Record y and the estimator's topics to a bag."""

import argparse
import math
from pathlib import Path
import shutil
import sys
import time

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.cli.command import progress, run_command
from fhaosmo_ros.topics import TOPIC_NAME


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if there is a valid bag, 2 also if nothing was recorded."""
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
    return run_command(parser, argv, _record)


def _record(arguments: argparse.Namespace, stop: Stop) -> None:
    if arguments.duration is not None and not arguments.duration > 0.0:
        raise ConfigurationError(f'--duration: expected > 0 s, got {arguments.duration:g}')
    path = arguments.output or Path(time.strftime('bag_%Y-%m-%d_%H-%M-%S'))
    if path.exists():
        raise ConfigurationError(f'output {path}: expected a new name, got one that exists')
    topics = arguments.topics or []
    for topic in topics:
        if not TOPIC_NAME.fullmatch(topic):
            raise ConfigurationError(f'--topics: expected a name such as /y, got {topic!r}')
    # Here, so that --help needs no ROS.
    from fhaosmo_ros.nodes.recording import TopicRecorder

    bag = BagWriter(path)
    recorder = TopicRecorder(
        bag,
        [] if topics else [f'/{name.strip("/")}' for name in arguments.names],
        [f'/{topic.strip("/")}' for topic in topics],
        arguments.all,
        arguments.ros_arguments,
    )
    try:
        with bag, recorder:
            # Says when it listens, so that a user knows when to start what is to be recorded.
            print(f'recording to {path}; Ctrl-C ends it', flush=True)
            end = time.monotonic() + (arguments.duration or math.inf)
            with progress(desc='record', unit=' messages') as bar:
                ended = False
                while not ended:
                    ended = stop.wait(0.05) or time.monotonic() >= end
                    recorder.check()
                    while recorder.problems:
                        bar.write(f'record: {recorder.problems.pop(0)}', file=sys.stderr)
                    bar.update(recorder.counts.total() - bar.n)
    except OSError as error:
        hint = '; `mcap recover` saves what was recorded' if path.exists() else ''
        raise ConfigurationError(
            f'output {path}: expected a place that can be written, got: '
            f'{error.strerror or error}{hint}'
        ) from None
    if not recorder.counts:
        shutil.rmtree(path)
        raise ConfigurationError('nothing was published on these topics: no bag kept')
    for topic, number in sorted(recorder.lost.items()):
        print(
            f'record: {topic}: {number} messages were lost on their way here (a busy machine or '
            'network; a deeper queue of the publisher helps)',
            file=sys.stderr,
        )
    print(f'{recorder.counts.total()} messages: {path}')
