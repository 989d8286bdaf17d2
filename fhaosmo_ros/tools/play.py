# SPDX-License-Identifier: Apache-2.0
"""Publish a bag's topics in the time of its stamps, with /clock; for a system without ros2 bag."""

import argparse
from itertools import count
from pathlib import Path
import time
from typing import TYPE_CHECKING

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.tools.cli.progress import progress

if TYPE_CHECKING:
    from fhaosmo_ros.nodes.recording.player import Player

CLOCK_PERIOD = 1_000_000
"""Longest time between two messages on /clock, in nanoseconds of the bag's time."""
NEVER_PLAYED = ('/clock', '/rosout', '/parameter_events')
MATCHED = 0.5
"""Seconds from when a subscriber has been found until it has found this publisher, too."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 at the end or after Ctrl-C."""
    return run_command(_parser(), argv, _play)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='play', description="Publish a bag's topics, and /clock."
    )
    add = parser.add_argument
    add('bag', type=Path)
    add('--topics', nargs='+', metavar='TOPIC', help='these only (default: all)')
    add('--exclude', nargs='+', default=[], metavar='NAME', help='not those below these names')
    add('--rate', type=float, default=1.0, help='times real time (default: %(default)g)')
    add('--loop', action='store_true', help='begin again at the end, until Ctrl-C')
    add(
        '--delay',
        type=float,
        default=4.0,
        metavar='SECONDS',
        help='begin so long after the topics appear: nodes take up to 3 s to find them and '
        'lose what is published before that (default: %(default)g)',
    )
    add(
        '--wait',
        nargs='*',
        default=[],
        metavar='TOPIC',
        help='begin once each of these has a subscriber',
    )
    return parser


def _play(arguments: argparse.Namespace, stop: Stop) -> None:
    if not 1e-3 <= arguments.rate <= 1e3:
        raise ConfigurationError(f'--rate: expected 0.001 to 1000, got {arguments.rate:g}')
    if not 0.0 <= arguments.delay <= 3600.0:
        raise ConfigurationError(f'--delay: expected 0 to 3600 s, got {arguments.delay:g}')
    from fhaosmo_ros.nodes.recording.player import Player  # here, so that --help needs no ROS

    with BagReader(arguments.bag) as reader:
        for topic in arguments.topics or []:
            reader.message_type(topic)
        below = tuple(f'{name.rstrip("/")}/' for name in arguments.exclude)
        topics = {
            c.topic: (
                c.msgtype,
                any(q.durability.name == 'TRANSIENT_LOCAL' for q in reader.offered(c)[0]),
            )
            for c in reader.connections
            if c.topic in (arguments.topics or [c.topic])
            and c.topic not in (*NEVER_PLAYED, *arguments.exclude)
            and not c.topic.startswith(below)
        }
        if not topics or not sum(reader.count(topic) for topic in topics):
            raise ConfigurationError(f'bag {arguments.bag}: expected a message to play, got none')
        with Player(topics, arguments.ros_arguments) as player:
            for topic in player.missing:
                print(f'play: not played: {topic}: {topics[topic][0]} is not installed here')
            print(
                f'playing {len(topics) - len(player.missing)} topics; Ctrl-C ends it', flush=True
            )
            if not _wait(player, arguments, stop):
                return
            for turn in count(1):
                _once(reader, player, list(topics), arguments.rate, turn, stop)
                if stop.is_set() or not arguments.loop:
                    return


def _wait(player: 'Player', arguments: argparse.Namespace, stop: Stop) -> bool:
    """Give nodes the time to find the topics; return False if it is to stop."""
    begin = time.monotonic() + arguments.delay
    while not all(player.subscribers(player.resolved(topic)) for topic in arguments.wait):
        if stop.wait(0.05):
            return False
    found = time.monotonic() + (MATCHED if arguments.wait else 0.0)
    return not stop.wait(max(0.0, begin - time.monotonic(), found - time.monotonic()))


def _once(
    reader: BagReader, player: 'Player', topics: list[str], rate: float, turn: int, stop: Stop
) -> None:
    begin, now = time.monotonic_ns(), None
    total = sum(reader.count(topic) for topic in topics)
    with progress(total=total, unit='message', desc=f'play {turn}', unit_scale=True) as bar:
        for topic, stamp, data, _ in reader.messages(topics):
            if now is None:
                first = now = stamp
                player.tick(now)
            while now < stamp:  # the clock goes on between the messages
                now = min(now + CLOCK_PERIOD * max(1, round(rate)), stamp)
                pause = (now - first) / rate - (time.monotonic_ns() - begin)
                if pause > 0 and stop.wait(pause * 1e-9):
                    return
                player.tick(now)
            if stop.is_set():
                return
            player.publish(topic, data)
            bar.update()
