# SPDX-License-Identifier: Apache-2.0
"""Counters on /diagnostics, once a second."""

from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node


class DiagnosticsPublisher:
    """
    Publishes a node's report: WARN if a counter of bad events grew since the last one.

    Parameters
    ----------
    report : callable
        Returns values by name; those named 'rejected ...', 'restarts' and 'samples lost' count
        bad events.

    """

    def __init__(self, node: Node, report: Callable[[], dict[str, Any]]) -> None:
        self._node = node
        self._report = report
        self._before = 0
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        node.create_timer(1.0, self.publish)

    def publish(self) -> None:
        """Publish one report."""
        values = self._report()
        bad = sum(
            value for key, value in values.items()
            if key.startswith('rejected') or key in ('restarts', 'samples lost')
        )  # fmt: skip
        warn = bad > self._before
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if warn else DiagnosticStatus.OK,
            name=self._node.get_fully_qualified_name().lstrip('/'),
            message=f'{bad - self._before} bad samples in the last second' if warn else 'OK',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        self._before = bad
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
