# SPDX-License-Identifier: Apache-2.0
"""Publishes serialised messages and /clock."""

from collections.abc import Sequence
from typing import Any

from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.nodes.recording.private_node import PrivateNode
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class Player(PrivateNode):
    """
    A node that publishes serialised messages and the time while it is open.

    Parameters
    ----------
    topics : dict of str to (str, bool)
        Message type by topic, and True for a transient-local topic.
    ros_arguments : sequence of str
        See `PrivateNode`.

    Attributes
    ----------
    missing : list of str
        Topics whose message type is not installed here.

    """

    def __init__(
        self, topics: dict[str, tuple[str, bool]], ros_arguments: Sequence[str] = ()
    ) -> None:
        self.missing: list[str] = []
        super().__init__('fhaosmo_player', ros_arguments)
        self._publish: dict[str, Any] = {}
        self._clock = self.node.create_publisher(Clock, '/clock', 10).publish
        for topic, (message_type, latched) in topics.items():
            try:
                kind = message_class(message_type)
            except LookupError:
                self.missing.append(topic)
                continue
            qos = LATCHED if latched else QOS
            self._publish[topic] = self.node.create_publisher(kind, topic, qos).publish

    def publish(self, topic: str, data: bytes) -> None:
        """Publish a message in CDR."""
        if topic in self._publish:
            self._publish[topic](data)

    def tick(self, now: int) -> None:
        """Publish the time in nanoseconds on /clock."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now, 1_000_000_000)
        self._clock(message)
