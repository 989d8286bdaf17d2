# SPDX-License-Identifier: Apache-2.0
"""Subscribes topics as serialised bytes and hands them, with their stamps, to a sink."""

from collections.abc import Callable, Mapping
import threading
from typing import Any

from fhaosmo_ros.nodes.spin import Spinner
from fhaosmo_ros.nodes.subscription import subscribe_with_info
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

QOS = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)


class Recorder:
    """
    A node in a context of its own that records while it is open.

    Parameters
    ----------
    topics : mapping of str to type
        Message class by topic.
    sink : callable
        Called as ``sink(topic, stamp, data)`` with the source time stamp in nanoseconds and the
        message in CDR, from the executor's thread.

    """

    def __init__(self, topics: Mapping[str, Any], sink: Callable[[str, int, bytes], None]) -> None:
        self.counts = dict.fromkeys(topics, 0)
        self._arrived = threading.Condition()
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node('fhaosmo_recorder', context=self._context, use_global_arguments=False)
        for topic, message_type in topics.items():
            subscribe_with_info(
                self._node, message_type, topic, self._callback(topic, sink), QOS, raw=True
            )
        self._spinner = Spinner(self._node)

    def _callback(self, topic: str, sink: Callable[[str, int, bytes], None]) -> Any:
        def receive(data: bytes, info: Mapping[str, int]) -> None:
            sink(topic, info['source_timestamp'], data)
            with self._arrived:
                self.counts[topic] += 1
                self._arrived.notify_all()

        return receive

    def __enter__(self) -> 'Recorder':
        self._spinner.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._spinner.__exit__()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def publishers(self, topic: str) -> int:
        """Return how many publishers of a topic have been discovered."""
        return int(self._node.count_publishers(topic))

    def subscribers(self, topic: str) -> int:
        """Return how many subscribers of a topic have been discovered."""
        return int(self._node.count_subscribers(topic))
