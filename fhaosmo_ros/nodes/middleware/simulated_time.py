# SPDX-License-Identifier: Apache-2.0
"""Time from /clock: a node survives whatever is published there."""

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rosgraph_msgs.msg import Clock


class TimedNode(Node):
    """
    A node that ignores messages on /clock with negative seconds, and logs them.

    In rclpy 7.1 they raise ValueError in its subscription of /clock, which ends the node.
    """

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
        self.get_logger().warning(
            f'rejected a time on /clock: expected seconds >= 0, got {message.clock.sec}',
            throttle_duration_sec=5.0,
        )
