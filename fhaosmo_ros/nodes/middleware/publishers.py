# SPDX-License-Identifier: Apache-2.0
"""Publishers whose QoS a user may override by parameters qos_overrides./TOPIC.publisher.POLICY."""

from collections.abc import Iterable, Mapping
import re
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

DEPTH = 1000
"""
A second of samples at 1 kHz. Fast DDS has been seen not to deliver for 0.2 s, seconds after a node
has joined; what the publisher still keeps then is sent again.
"""
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Who comes later still gets the latest messages."""
POLICIES: dict[QoSPolicyKind, tuple[str, ...] | range] = {
    QoSPolicyKind.HISTORY: ('keep_last', 'keep_all'),
    QoSPolicyKind.DEPTH: range(1, 100_001),
    QoSPolicyKind.RELIABILITY: ('reliable', 'best_effort'),
    QoSPolicyKind.DURABILITY: ('volatile', 'transient_local'),
}
"""QoS policies that a user may override, with the values that each may have."""
OVERRIDES = 'qos_overrides.'
OF_RCLPY = tuple(f'{OVERRIDES}{topic}.' for topic in ('/clock', '/parameter_events', '/rosout'))
"""Topics whose QoS can be overridden in every node of rclpy."""


def create_publisher(node: Node, kind: Any, topic: str, latched: bool = False) -> Any:
    """Return a publisher, reliable unless the user wants another QoS; latched: transient-local."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return node.create_publisher(
        kind,
        topic,
        QoSProfile(depth=LATCHED.depth if latched else DEPTH, durability=durability),
        qos_overriding_options=QoSOverridingOptions(POLICIES),
    )


def has_listeners(publisher: Any) -> bool:
    """Return whether anybody listens; to a latched topic always those who come later."""
    latched = publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return bool(latched or publisher.get_subscription_count())


def full_name(node: Node, topic: str) -> str:
    """Return the full name of a topic, after remapping; raise if no topic can have it."""
    try:
        return str(node.resolve_topic_name(topic))
    except RuntimeError as error:  # rcl's
        problem = re.sub(r'^.*?: |, at \S+$', '', str(error))
        raise ConfigurationError(
            f'expected the name of a topic, got {topic!r} ({problem})'
        ) from None


def check_overrides(node: Node, given: Mapping[str, Any], topics: Iterable[str]) -> None:
    """
    Raise for QoS overrides that rclpy would ignore, or refuse with an unclear message.

    Parameters
    ----------
    node : Node
    given : mapping
        All that files and the command line set.
    topics : iterable of str
        All topics that the node makes by `create_publisher`.

    """
    names = [full_name(node, topic) for topic in topics]
    policies = {policy.name.lower(): allowed for policy, allowed in POLICIES.items()}
    for name, value in given.items():
        if not name.startswith(OVERRIDES) or name.startswith(OF_RCLPY):
            continue
        topic, _, policy = name.removeprefix(OVERRIDES).rpartition('.publisher.')
        allowed = policies.get(policy)
        if topic not in names or allowed is None:
            expected = (
                f'TOPIC.publisher.POLICY with TOPIC one of {", ".join(names)} and POLICY one of '
                f'{", ".join(policies)}'
            )
            raise ConfigurationError(f"parameter '{name}': expected {expected}")
        if value not in allowed:
            number = f'an integer from {allowed[0]} to {allowed[-1]}'
            expected = number if isinstance(allowed, range) else ' or '.join(allowed)
            raise ConfigurationError(f"parameter '{name}': expected {expected}, got {value!r}")
