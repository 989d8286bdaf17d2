# SPDX-License-Identifier: Apache-2.0
"""Time from /clock that a node survives, whatever is published there."""

from rclpy.node import Node
from rosgraph_msgs.msg import Clock


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
