# SPDX-License-Identifier: Apache-2.0
"""A node that a tool makes for itself."""

from types import TracebackType
from typing import Self

from fhaosmo_ros.nodes.spin import Spinner
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


class PrivateNode:
    """
    A node in a context of its own, which takes no signals and no arguments; spun while open.

    Attributes
    ----------
    node : Node

    """

    def __init__(self, name: str) -> None:
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(name, context=self._context, use_global_arguments=False)

    def __enter__(self) -> Self:
        self._spinner = Spinner(self.node).__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._spinner.__exit__(kind, error, trace)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def publishers(self, topic: str) -> int:
        """Return how many publishers of a topic have been discovered."""
        return int(self.node.count_publishers(topic))

    def subscribers(self, topic: str) -> int:
        """Return how many subscribers of a topic have been discovered."""
        return int(self.node.count_subscribers(topic))
