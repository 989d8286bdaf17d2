# SPDX-License-Identifier: Apache-2.0
"""The topics on which a channel publishes its estimates."""

from fhaosmo_ros.core.observer.observer import Estimate
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.messages import (
    array_encoder,
    double_encoder,
    message_class,
    time_encoder,
)
from fhaosmo_ros.topics import ESTIMATES
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

POLICIES: dict[QoSPolicyKind, tuple[str, ...] | range] = {
    QoSPolicyKind.HISTORY: ('keep_last', 'keep_all'),
    QoSPolicyKind.DEPTH: range(1, 100_001),
    QoSPolicyKind.RELIABILITY: ('reliable', 'best_effort'),
    QoSPolicyKind.DURABILITY: ('volatile', 'transient_local'),
}
"""QoS policies that a user may override, with the values that each may have."""
DEPTH = 10
OF_RCLPY = ('/clock.', '/parameter_events.', '/rosout.')
"""Topics whose QoS can be overridden in every node of rclpy."""


class Outputs:
    """
    Publishers of the estimates, each with ROS' parameters qos_overrides./TOPIC.publisher.POLICY.

    Parameters
    ----------
    node : Node
    prefix : str
        Prefix of the topics' names.
    order, levels : int
        Numbers of states and of innovations.

    """

    def __init__(self, node: Node, prefix: str, order: int, levels: int) -> None:
        self._node = node
        self._publishers = [
            node.create_publisher(
                message_class(kind),
                prefix + name,
                QoSProfile(depth=DEPTH),
                qos_overriding_options=QoSOverridingOptions(POLICIES),
            )
            for name, kind in ESTIMATES.items()
        ]
        self._state, self._unknown_input, self._gamma, self._innovation, self._stamp = (
            publisher.publish for publisher in self._publishers
        )
        self._encode_state = array_encoder([f'z{i + 1}' for i in range(order)])
        self._encode_innovation = array_encoder([f'eps{i + 1}' for i in range(levels)])
        self._encode_double, self._encode_time = double_encoder(), time_encoder()

    def publish(self, estimate: Estimate, stamp: int) -> None:
        """Publish an estimate and, last, the stamp of its sample in nanoseconds."""
        self._state(self._encode_state(estimate.z))
        self._unknown_input(self._encode_double(estimate.unknown_input))
        self._gamma(self._encode_double(estimate.gamma))
        self._innovation(self._encode_innovation(estimate.innovation))
        self._stamp(self._encode_time(stamp))

    def destroy(self) -> None:
        """Take the publishers away."""
        while self._publishers:
            self._node.destroy_publisher(self._publishers.pop())


def check_overrides(node: Node, prefixes: list[str]) -> None:
    """
    Raise for QoS overrides that rclpy would ignore, or refuse with an unclear message.

    Parameters
    ----------
    node : Node
    prefixes : list of str
        Of all outputs of the node.

    Raises
    ------
    ConfigurationError
        A topic that is none of the outputs, or a policy or value that can't be set.

    """
    topics = [node.resolve_topic_name(p + name) for p in prefixes for name in ESTIMATES]
    policies = {policy.name.lower(): allowed for policy, allowed in POLICIES.items()}
    for name, parameter in node.get_parameters_by_prefix('qos_overrides').items():
        if name.startswith(OF_RCLPY):
            continue
        topic, _, policy = name.rpartition('.publisher.')
        if topic not in topics or policy not in policies:
            raise ConfigurationError(
                f"parameter 'qos_overrides.{name}': expected TOPIC.publisher.POLICY with TOPIC "
                f'one of {", ".join(topics)} and POLICY one of {", ".join(policies)}'
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
