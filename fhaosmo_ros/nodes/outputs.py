# SPDX-License-Identifier: Apache-2.0
"""The topics on which a channel publishes its estimates."""

from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.observer import Estimate
from fhaosmo_ros.nodes.messages import array_encoder, double_encoder, time_encoder
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import Float64, Float64MultiArray

POLICIES = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)
DEPTH = 10


class Outputs:
    """
    Publishers of the estimates, each with ROS' parameters qos_overrides./TOPIC.publisher.POLICY.

    Parameters
    ----------
    node : Node
    prefix : str
        Stands before the topics' names.
    order, levels : int
        Numbers of states and of innovations.

    Raises
    ------
    ConfigurationError
        QoS overrides that can't be used.

    """

    def __init__(self, node: Node, prefix: str, order: int, levels: int) -> None:
        self._node = node
        self._publishers: list[Any] = []
        try:
            self._state = self._publisher(prefix + 'state', Float64MultiArray)
            self._unknown_input = self._publisher(prefix + 'unknown_input', Float64)
            self._gamma = self._publisher(prefix + 'gamma', Float64)
            self._innovation = self._publisher(prefix + 'innovation', Float64MultiArray)
            self._stamp = self._publisher(prefix + 'stamp', Time)
        except ConfigurationError:
            self.destroy()
            raise
        self._encode_state = array_encoder([f'z{i + 1}' for i in range(order)])
        self._encode_innovation = array_encoder([f'eps{i + 1}' for i in range(levels)])
        self._encode_double, self._encode_time = double_encoder(), time_encoder()

    def _publisher(self, topic: str, kind: Any) -> Any:
        try:
            publisher = self._node.create_publisher(
                kind, topic, QoSProfile(depth=DEPTH),
                qos_overriding_options=QoSOverridingOptions(POLICIES),
            )  # fmt: skip
        except Exception as error:  # rclpy raises several kinds, none of them its own
            raise ConfigurationError(
                f'qos_overrides of {self._node.resolve_topic_name(topic)}: expected ROS QoS '
                f'policies, got: {error}'
            ) from None
        self._publishers.append(publisher)
        return publisher.publish

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
