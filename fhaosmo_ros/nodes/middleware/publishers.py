# SPDX-License-Identifier: Apache-2.0
"""Publishers whose QoS a user may override by parameters qos_overrides./TOPIC.publisher.POLICY."""

from collections.abc import Callable, Iterable
import re
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

DEPTH = 1000
"""
A second of samples at 1 kHz. Fast DDS has been seen not to deliver for 0.2 s, seconds after a node
has joined; what the publisher still keeps then is sent again.
"""
POLICIES: dict[QoSPolicyKind, tuple[str, ...] | range] = {
    QoSPolicyKind.HISTORY: ('keep_last', 'keep_all'),
    QoSPolicyKind.DEPTH: range(1, 100_001),
    QoSPolicyKind.RELIABILITY: ('reliable', 'best_effort'),
    QoSPolicyKind.DURABILITY: ('volatile', 'transient_local'),
}
"""QoS policies that a user may override, with the values that each may have."""
OF_RCLPY = ('/clock.', '/parameter_events.', '/rosout.')
"""Topics whose QoS can be overridden in every node of rclpy."""


def create_publisher(
    node: Node, kind: Any, topic: str, depth: int = DEPTH, latched: bool = False
) -> Any:
    """Return a publisher, reliable unless the user wants another QoS; latched: transient-local."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return node.create_publisher(
        kind,
        topic,
        QoSProfile(depth=depth, durability=durability),
        qos_overriding_options=QoSOverridingOptions(POLICIES),
    )


def listeners_of(publisher: Any) -> Callable[[], int]:
    """
    Return a function that tells how many listen, so that nothing is encoded for nobody.

    A transient-local publisher always has one: whoever comes later gets its last messages.
    """
    if publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        return lambda: 1
    count: Callable[[], int] = publisher.handle.get_subscription_count
    return count


def full_name(node: Node, topic: str) -> str:
    """
    Return the full name of a topic, after remapping.

    Raises
    ------
    ConfigurationError
        No topic can have this name, for instance because it is too long.

    """
    try:
        return str(node.resolve_topic_name(topic))
    except rclpy_implementation.RCLError as error:
        problem = re.sub(r'^.*?: |, at \S+$', '', str(error))
        raise ConfigurationError(
            f'expected the name of a topic, got {topic!r} ({problem})'
        ) from None


def check_overrides(node: Node, topics: Iterable[str]) -> None:
    """
    Raise for QoS overrides that rclpy would ignore, or refuse with an unclear message.

    Parameters
    ----------
    node : Node
    topics : iterable of str
        All topics that the node makes by `create_publisher`.

    Raises
    ------
    ConfigurationError
        A name that is none of a topic, an override of another topic, or a policy or value that
        can't be set.

    """
    names = [full_name(node, topic) for topic in topics]
    policies = {policy.name.lower(): allowed for policy, allowed in POLICIES.items()}
    for name, parameter in node.get_parameters_by_prefix('qos_overrides').items():
        if name.startswith(OF_RCLPY):
            continue
        topic, _, policy = name.rpartition('.publisher.')
        if topic not in names or policy not in policies:
            raise ConfigurationError(
                f"parameter 'qos_overrides.{name}': expected TOPIC.publisher.POLICY with TOPIC "
                f'one of {", ".join(names)} and POLICY one of {", ".join(policies)}'
            )
        allowed = policies[policy]
        if parameter.value not in allowed:
            words = (
                ' or '.join(allowed)
                if isinstance(allowed, tuple)
                else f'an integer from {allowed[0]} to {allowed[-1]}'
            )
            raise ConfigurationError(
                f"parameter 'qos_overrides.{name}': expected {words}, got {parameter.value!r}"
            )
