# SPDX-License-Identifier: Apache-2.0
"""Time from /clock: a node survives whatever is published there, and says what is wrong."""

from time import monotonic

from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, WARN
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

PATIENCE = 2.0
"""Seconds of the host for which simulated time may stand still."""


def reject_negative_time(node: Node) -> None:
    """
    Let a node ignore messages on /clock with negative seconds, and log how many there were.

    rclpy 7.1 raises ValueError for them in its subscription of /clock, which ends the node.
    """
    source = node._time_source
    take = source.clock_callback
    rejected = 0

    def clock_callback(message: Clock) -> None:
        nonlocal rejected
        if message.clock.sec >= 0:
            take(message)
            return
        rejected += 1
        node.get_logger().warning(
            f'rejected a time on /clock: expected seconds >= 0, got {message.clock.sec} '
            f'({rejected} rejected so far)',
            throttle_duration_sec=5.0,
        )

    source.clock_callback = clock_callback  # for a later use_sim_time
    if source._clock_sub is not None:
        source._clock_sub.callback = clock_callback


class ClockWatch:
    """
    Finds that simulated time has not begun, or does not go on.

    Parameters
    ----------
    node : Node
        Whose clock it is, and whose log.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._topic = node.resolve_topic_name('/clock')
        self._time = 0
        self._since = monotonic()
        self._told = False

    def look(self) -> list[tuple[bytes, str]]:
        """Return what is wrong, with its level for /diagnostics; log it once."""
        node = self._node
        if not node.get_parameter('use_sim_time').value:
            return []
        time, now = node.get_clock().now().nanoseconds, monotonic()
        if time == 0:
            return [(ERROR, f'use_sim_time, but nothing on {self._topic} yet')]
        if time != self._time:
            self._time, self._since, self._told = time, now, False
        still = now - self._since
        if still < PATIENCE:
            return []
        gone = not node.count_publishers(self._topic)
        reason = 'nobody publishes it any more' if gone else 'paused, or its publisher hangs'
        text = f'the time on {self._topic} stands still for {still:.0f} s: {reason}'
        if not self._told:
            self._told = True
            node.get_logger().warning(text)
        return [(ERROR if gone else WARN, text)]
