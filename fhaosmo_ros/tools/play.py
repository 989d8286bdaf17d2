# SPDX-License-Identifier: Apache-2.0
"""Publish a bag's topics in the time of its stamps, with /clock; for a system without ros2 bag."""

import argparse
from pathlib import Path
import sys
import time

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.types import serialise, TYPES
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.topics import TIME

CLOCK, CLOCK_PERIOD = 'rosgraph_msgs/msg/Clock', 1_000_000  # ns, at most, of the bag's time
DISCOVERY = 4.0  # seconds: nodes lose what is published before they find the topics
NEVER_PLAYED = ('/clock', '/rosout', '/parameter_events')


def main(argv: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog='play', description="Publish a bag's topics and /clock.")
    parser.add_argument('bag', type=Path)
    parser.add_argument('--topics', nargs='+', metavar='TOPIC', help='these only (default: all)')
    return run_command(parser, argv, _play)


def _play(arguments: argparse.Namespace, stop: Stop) -> None:
    # Here, so that --help needs no ROS.
    from fhaosmo_ros.nodes.recording import PrivateNode

    with BagReader(arguments.bag) as reader:
        wanted = arguments.topics or [c.topic for c in reader.connections if c.msgcount]
        topics = {t: reader.message_type(t) for t in wanted if t not in NEVER_PLAYED}
        latched = {
            c.topic
            for c in reader.connections
            if any(q.durability.name == 'TRANSIENT_LOCAL' for q in c.ext.offered_qos_profiles)
        }
        with PrivateNode('fhaosmo_player', arguments.ros_arguments) as node:
            publish_clock, publish = node.publisher('/clock', CLOCK, False), {}
            for topic, kind in topics.items():
                try:
                    publish[topic] = node.publisher(topic, kind, topic in latched)
                except LookupError:
                    print(f'play: not played: {topic}: {kind} is not installed', file=sys.stderr)
            if not publish:
                raise ConfigurationError(f'{arguments.bag}: expected a message to play, got none')
            print(f'playing {len(publish)} topics; Ctrl-C ends it', flush=True)
            stop.wait(DISCOVERY)
            now = ahead = 0
            for topic, stamp, data, _ in reader.messages(publish):
                if not now:
                    now, ahead = stamp - 1, stamp - time.monotonic_ns()
                while now < stamp:  # the clock goes on between the messages
                    now = min(now + CLOCK_PERIOD, stamp)
                    if stop.wait(max(0.0, (now - ahead - time.monotonic_ns()) * 1e-9)):
                        return
                    publish_clock(serialise(CLOCK, clock=TYPES.types[TIME](*divmod(now, 10**9))))
                publish[topic](data)
