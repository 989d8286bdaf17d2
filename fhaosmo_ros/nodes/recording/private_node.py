# SPDX-License-Identifier: Apache-2.0
"""A node that a tool makes for itself."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
import shlex
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.nodes.middleware.spin import Spinner
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

DEPTH = 1000
ACTING = ('-r', '--remap', '-e', '--enclave')
"""ROS arguments that act."""


class PrivateNode:
    """
    A `node` in a context of its own, without signal handlers; spun while open.

    Parameters
    ----------
    name : str
    ros_arguments : sequence of str
        What follows ``--ros-args``. Names and remappings (-r) and the enclave (-e) act; the rest,
        parameters and log levels that launch gives to every node, does not concern this one.

    """

    def __init__(self, name: str, ros_arguments: Sequence[str] = ()) -> None:
        self._context = Context()
        self._clients: dict[str, AsyncParameterClient] = {}
        acting = ['--ros-args']
        for pair in pairwise(ros_arguments):
            acting += pair if pair[0] in ACTING else ()
        no_handlers = SignalHandlerOptions.NO
        try:
            rclpy.init(args=acting, context=self._context, signal_handler_options=no_handlers)
            self.node = Node(name, context=self._context)
        except RuntimeError as error:
            raise ConfigurationError(f'ROS arguments {shlex.join(acting)}: {error}') from None

    def __enter__(self) -> 'PrivateNode':
        self._spinner = Spinner(self.node).__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._spinner.__exit__(*error)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def resolved(self, name: str) -> str:
        """Return the full name of a topic, or of a node, after remapping."""
        return self.node.resolve_topic_name(name)

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> None:
        """Ask another node to change parameters; what it answers is not waited for."""
        changes = [Parameter(name, value=value) for name, value in values.items()]
        self._client(node).set_parameters(changes)

    def can_set_parameters(self, node: str) -> bool:
        """
        Return whether another node offers its parameters.

        Asked early, it makes a client early: the first request of a new one can wait 3 s.
        """
        return bool(self._client(node).services_are_ready())

    def _client(self, node: str) -> AsyncParameterClient:
        if node not in self._clients:
            self._clients[node] = AsyncParameterClient(self.node, node)
        return self._clients[node]

    def publisher(
        self, topic: str, message_type: str, transient_local: bool
    ) -> Callable[[bytes], None]:
        """
        Return a function that publishes messages in CDR.

        Raises
        ------
        LookupError
            The message type is not installed here.

        """
        qos = QoSProfile(depth=DEPTH)
        if transient_local:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        publisher = self.node.create_publisher(message_class(message_type), topic, qos)
        return publisher.publish  # type: ignore[no-any-return]

    def publishers(self, topic: str) -> int:
        """Return how many publishers of a topic have been discovered."""
        return int(self.node.count_publishers(topic))
