# SPDX-License-Identifier: Apache-2.0
"""Time from /clock: a node survives whatever is published there, and says what is wrong."""

from collections.abc import Callable
from functools import partial
from time import monotonic
from typing import Any

from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, Report, WARN
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

PATIENCE = 2.0
"""Seconds of the host for which simulated time may stand still."""


class TimedNode(Node):
    """
    A node that ignores messages on /clock with negative seconds, and logs how many there were.

    In rclpy 7.1 they raise ValueError in its subscription of /clock, which ends the node.
    """

    _rejected = 0

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, *arguments: Any, **options: Any
    ) -> Any:
        """Return a subscription; that of /clock, which rclpy makes, passes over such times."""
        if msg_type is Clock:
            callback = partial(self._take_time, callback)
        return super().create_subscription(msg_type, topic, callback, *arguments, **options)

    def _take_time(self, take: Callable[[Clock], None], message: Clock) -> None:
        if message.clock.sec >= 0:
            take(message)
            return
        self._rejected += 1
        self.get_logger().warning(
            f'rejected a time on /clock: expected seconds >= 0, got {message.clock.sec} '
            f'({self._rejected} rejected so far)',
            throttle_duration_sec=5.0,
        )


class ClockWatch:
    """Finds that a node's simulated time has not begun, or does not go on."""

    def __init__(self, node: Node) -> None:
        self._node, self._topic = node, node.resolve_topic_name('/clock')
        self._time, self._since, self._told = 0, monotonic(), False

    def look(self, report: Report) -> None:
        """Add what is wrong to a report; log it once."""
        node = self._node
        if not node.get_parameter('use_sim_time').value:
            return
        time, now = node.get_clock().now().nanoseconds, monotonic()
        if time == 0:
            report.find(ERROR, f'use_sim_time, but nothing on {self._topic} yet')
            return
        if time != self._time:
            self._time, self._since, self._told = time, now, False
        still = now - self._since
        if still < PATIENCE:
            return
        gone = not node.count_publishers(self._topic)
        reason = 'nobody publishes it any more' if gone else 'paused, or its publisher hangs'
        text = f'the time on {self._topic} stands still for {still:.0f} s: {reason}'
        if not self._told:
            self._told = True
            node.get_logger().warning(text)
        report.find(ERROR if gone else WARN, text)
