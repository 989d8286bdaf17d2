# SPDX-License-Identifier: Apache-2.0
"""Publishes serialised messages and /clock."""

import importlib
from typing import Any

from fhaosmo_ros.nodes.spin import Spinner
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class Player:
    """
    A node in a context of its own.

    Parameters
    ----------
    topics : dict of str to (str, bool)
        Message type by topic, and True where late subscribers shall get old messages too.

    Attributes
    ----------
    missing : list of str
        Topics whose message type is not installed here.

    """

    def __init__(self, topics: dict[str, tuple[str, bool]]) -> None:
        self.missing: list[str] = []
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node('fhaosmo_player', context=self._context, use_global_arguments=False)
        self._publish: dict[str, Any] = {}
        self._clock = self._node.create_publisher(Clock, '/clock', 10).publish
        for topic, (message_type, latched) in topics.items():
            package, kind, name = message_type.split('/')
            try:
                message_class = getattr(importlib.import_module(f'{package}.{kind}'), name)
            except (ImportError, AttributeError):
                self.missing.append(topic)
                continue
            qos = LATCHED if latched else QOS
            self._publish[topic] = self._node.create_publisher(message_class, topic, qos).publish
        self._spinner = Spinner(self._node)

    def __enter__(self) -> 'Player':
        self._spinner.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._spinner.__exit__()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def subscribers(self, topic: str) -> int:
        """Return how many subscribers of a topic have been discovered."""
        return int(self._node.count_subscribers(topic))

    def publish(self, topic: str, data: bytes) -> None:
        """Publish a message in CDR."""
        if topic in self._publish:
            self._publish[topic](data)

    def tick(self, now: int) -> None:
        """Publish the time in nanoseconds on /clock."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now, 1_000_000_000)
        self._clock(message)
