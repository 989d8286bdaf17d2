# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that also deliver a message's source time stamp."""

from collections.abc import Callable, Mapping
import inspect
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

SENSOR_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort matches every publisher; the queue holds one second at 1 kHz."""


def input_qos(values: Mapping[str, Any]) -> QoSProfile:
    """Return the QoS that the parameters input_reliability, _durability and _depth ask for."""
    return QoSProfile(
        depth=values['input_depth'],
        reliability=ReliabilityPolicy[values['input_reliability'].upper()],
        durability=DurabilityPolicy[values['input_durability'].upper()],
    )


def subscribe_with_info(
    node: Node,
    message_type: Any,
    topic: str,
    callback: Callable[[Any, dict[str, int]], None],
    qos: QoSProfile,
    raw: bool = False,
) -> Any:
    """
    Subscribe with a callback that takes the message and its info.

    rclpy delivers the info if the callback's signature has two parameters. The events executor of
    rclpy 7.1 passes both as one tuple, the other executors as two arguments; the adapter takes
    either.
    """

    def adapter(message: Any, info: Any = None) -> None:
        if info is None:
            message, info = message
        callback(message, info)

    adapter.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return node.create_subscription(
        message_type,
        topic,
        adapter,
        qos,
        raw=raw,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
    )
