# SPDX-License-Identifier: Apache-2.0
"""Subscribes topics as serialised bytes and hands them, with their stamps, to a sink."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

from fhaosmo_ros.nodes.private_node import PrivateNode
from fhaosmo_ros.nodes.subscription import subscribe_with_info
from rclpy.qos import DurabilityPolicy, QoSProfile

QOS = QoSProfile(depth=5000)
LATCHED = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Recorder(PrivateNode):
    """
    A node that records while it is open.

    Parameters
    ----------
    topics : mapping of str to type
        Message class by topic.
    sink : callable
        Called as ``sink(topic, stamp, data)`` with the source time stamp in nanoseconds and the
        message in CDR, from the executor's thread.
    latched : collection of str
        Topics whose publishers keep messages for who comes late.

    """

    def __init__(
        self, topics: Mapping[str, Any], sink: Callable[[str, int, bytes], None],
        latched: Collection[str] = (),
    ) -> None:  # fmt: skip
        self.counts = dict.fromkeys(topics, 0)
        super().__init__('fhaosmo_recorder')
        for topic, message_type in topics.items():
            qos = LATCHED if topic in latched else QOS
            subscribe_with_info(
                self.node, message_type, topic, self._callback(topic, sink), qos, raw=True
            )

    def _callback(self, topic: str, sink: Callable[[str, int, bytes], None]) -> Any:
        def receive(data: bytes, info: Mapping[str, int]) -> None:
            sink(topic, info['source_timestamp'], data)
            self.counts[topic] += 1

        return receive
