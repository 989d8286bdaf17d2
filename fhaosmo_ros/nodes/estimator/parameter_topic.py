# SPDX-License-Identifier: Apache-2.0
"""A node's parameters on a topic, so that a bag says with which ones its estimates were made."""

from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.per_channel import CHANNELS, differing, of_channel
from fhaosmo_ros.inputs import Input, known_inputs, measured_output
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.topics import PARAMETERS, TEXT
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

LATEST = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class ParameterTopic:
    """Publishes all parameters of a node as the text of a file that makes such a node."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(message_class(TEXT), f'~/{PARAMETERS}', LATEST)

    def publish(self, values: Parameters) -> None:
        """Publish the node's values; the topic is transient-local."""
        named = differing(values) | self._remapped(values)
        text = dumps(named, self._node.get_fully_qualified_name())
        self._publisher.publish(String(data=text))

    def _remapped(self, values: Parameters) -> dict[str, Any]:
        """Return the topics of y and u that a remapping has changed: a bag knows of none."""
        found: dict[str, Any] = {}
        for channel in values[CHANNELS]:
            prefix = f'{channel}.' if channel else ''
            own = of_channel(values, channel)
            y = measured_output(own, channel)
            if self._is_remapped(y):
                found[f'{prefix}input_topic'] = self._node.resolve_topic_name(y.topic)
                found[f'{prefix}input_type'] = y.message_type
            u = known_inputs(own, TriangularModel.of(own).used_inputs, channel).values()
            if any(map(self._is_remapped, u)):
                topics = [self._node.resolve_topic_name(one.topic) for one in u]
                found[f'{prefix}known_input_topics'] = topics
                found[f'{prefix}known_input_types'] = [one.message_type for one in u]
        return found

    def _is_remapped(self, wanted: Input) -> bool:
        plain = wanted.absolute(self._node.get_namespace())
        return self._node.resolve_topic_name(wanted.topic) != plain
