# SPDX-License-Identifier: Apache-2.0
"""What a node was set to, on a topic: so that a bag tells with what its estimates were made."""

from fhaosmo_ros.core.channel_parameters import differing
from fhaosmo_ros.core.parameter import ParameterTable
from fhaosmo_ros.core.parameter_file import dumps
from fhaosmo_ros.nodes.parameters import values_of
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

LATEST = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class ParameterTopic:
    """
    Publishes all parameters of a node as the text of a parameter file that makes such a node.

    Parameters
    ----------
    node : Node
    table : ParameterTable

    """

    def __init__(self, node: Node, table: ParameterTable) -> None:
        self._node, self._table = node, table
        self._publisher = node.create_publisher(String, '~/parameters', LATEST)

    def publish(self) -> None:
        """Publish the present values; who comes late gets the latest ones."""
        values = differing(values_of(self._node, self._table))
        text = dumps(values, self._node.get_fully_qualified_name())
        self._publisher.publish(String(data=text))

    def destroy(self) -> None:
        """Take the topic away."""
        self._node.destroy_publisher(self._publisher)
