# SPDX-License-Identifier: Apache-2.0
"""Publishes serialised messages and /clock."""

from collections.abc import Sequence
from typing import Any

from fhaosmo_ros.nodes.middleware.messages import message_class, time_message
from fhaosmo_ros.nodes.recording.private_node import PrivateNode
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock

DEPTH = 1000


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
        super().__init__('fhaosmo_player', ros_arguments)
        self.missing: list[str] = []
        self._publishers: dict[str, Any] = {}
        self._clock = self.node.create_publisher(Clock, '/clock', 10)
        for topic, (message_type, latched) in topics.items():
            qos = QoSProfile(depth=DEPTH)
            if latched:
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            try:
                kind = message_class(message_type)
                self._publishers[topic] = self.node.create_publisher(kind, topic, qos)
            except LookupError:
                self.missing.append(topic)

    def publish(self, topic: str, data: bytes) -> None:
        """Publish a message in CDR."""
        if topic in self._publishers:
            self._publishers[topic].publish(data)

    def tick(self, now: int) -> None:
        """Publish the time in nanoseconds on /clock."""
        self._clock.publish(Clock(clock=time_message(now)))
