# SPDX-License-Identifier: Apache-2.0
"""Publishers and subscriptions with QoS that a user may override; periods of timers."""

from collections.abc import Callable, Mapping
from copy import copy
import inspect
import math
import re
from time import monotonic
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.timer import Timer

LOOK = 0.1
"""Seconds; to find each other takes publishers and subscriptions longer than that."""
DEPTH = 1000
"""
A second of samples at 1 kHz. Fast DDS has been seen not to deliver for 0.2 s, seconds after a node
has joined; what the publisher still keeps then is sent again.
"""
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Who comes later still gets the latest messages."""
SENSOR_QOS = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort matches every publisher; the queue holds one second at 1 kHz."""
OVERRIDABLE = QoSOverridingOptions((
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY,
))  # fmt: skip
"""QoS policies that a user may override."""


def create_publisher(node: Node, kind: Any, topic: str, latched: bool = False) -> Any:
    """Return a publisher, reliable unless the user wants another QoS; latched: transient-local."""
    qos = copy(LATCHED) if latched else QoSProfile(depth=DEPTH)
    return node.create_publisher(kind, topic, qos, qos_overriding_options=OVERRIDABLE)


class Listeners:
    """
    Which topics of a node anybody listens to: a message that nobody hears need not be made.

    The middleware is asked every `LOOK` seconds at most: asking takes as long as making one.
    """

    def __init__(self, publishers: Mapping[str, Any]) -> None:
        self._publishers, self._looked = publishers, -math.inf
        self._heard: dict[str, Any] = {}

    def heard(self) -> dict[str, Any]:
        """Return the publishers that are heard, by name; those of latched topics always are."""
        now = monotonic()
        if now - self._looked > LOOK:
            self._looked, latched = now, DurabilityPolicy.TRANSIENT_LOCAL
            self._heard = {
                name: p
                for name, p in self._publishers.items()
                if p.get_subscription_count() or p.qos_profile.durability == latched
            }
        return self._heard


def full_name(node: Node, topic: str, what: str = '') -> str:
    """Return the full name of a topic, after remapping; raise (`what` first) if none can be."""
    try:
        return str(node.resolve_topic_name(topic))
    except RuntimeError as error:  # rcl's
        problem = re.sub(r'^.*?: |, at \S+$', '', str(error))
        text = f'{what}expected the name of a topic, got {topic!r} ({problem})'
        raise ConfigurationError(text) from None


def subscribe_with_info(
    node: Node,
    message_type: Any,
    topic: str,
    callback: Callable[[Any, dict[str, int]], None],
    qos: QoSProfile,
    **options: Any,
) -> Any:
    """Subscribe with a callback that takes the message and its info; `options` are of rclpy."""

    def adapter(message: Any, info: Any = None) -> None:
        if info is None:  # the events executor of rclpy 7.1 passes both as one tuple
            message, info = message
        callback(message, info)

    # rclpy delivers the info if the signature has two parameters.
    adapter.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return node.create_subscription(message_type, topic, adapter, qos, **options)


class SequenceNumbers:
    """
    Counts as `lost` the messages that did not arrive, by the numbers that a publisher gives them.

    A number that is not above the one before is another publisher's: there is no `single` one any
    more, and nothing is counted until there is one again.
    """

    def __init__(self) -> None:
        self.lost, self.single, self._before = 0, True, 0

    def take(self, info: Mapping[str, Any]) -> None:
        """Look at the number of a message."""
        number = info['publication_sequence_number'] or 0  # 0: the middleware has none
        if 0 < number <= self._before:
            self.single = False
        elif number and self._before:
            self.lost += number - self._before - 1
        self._before = number if self.single else 0


def set_period(timer: Timer, seconds: float) -> None:
    """Change a timer's period; a timer that is cancelled stays so."""
    period = round(seconds * 1e9)
    if period != timer.timer_period_ns:
        timer.timer_period_ns = period
        if not timer.is_canceled():
            timer.reset()  # else the events executor waits for the end of the old period
