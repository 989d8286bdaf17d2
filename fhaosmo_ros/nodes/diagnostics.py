# SPDX-License-Identifier: Apache-2.0
"""
Reports on /diagnostics, with the conventions of diagnostic_updater.

Not diagnostic_updater itself: no wheel of it exists, so nothing here could be tested without a
ROS. Reports come in the host's time: with use_sim_time they must not fall silent with /clock.
"""

from collections.abc import Callable, Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE,
)  # fmt: skip


class Report:
    """
    One status while it is made up: values, and the worst of its findings.

    Parameters
    ----------
    task : str
        What it is about; 'node: task' is its name.

    """

    def __init__(self, task: str) -> None:
        self.task = task
        self.values: dict[str, Any] = {}
        self._level = OK
        self._findings: list[str] = []

    def find(self, level: bytes, text: str) -> None:
        """Add a finding; the status gets the worst level, and the messages of all findings."""
        self._level = max(self._level, level)
        self._findings.append(text)

    def message(self, node: str, hardware_id: str) -> DiagnosticStatus:
        """Return the status message."""
        return DiagnosticStatus(
            level=self._level,
            name=f'{node}: {self.task}',
            message='; '.join(self._findings) or 'OK',
            hardware_id=hardware_id,
            values=[KeyValue(key=k, value=_text(v)) for k, v in self.values.items()],
        )


class DiagnosticsPublisher:
    """
    Publishes a node's reports.

    Parameters
    ----------
    reports : callable
        Returns the reports of now.
    period : float
        Seconds between two, of the host's steady clock.

    """

    def __init__(
        self,
        node: Node,
        reports: Callable[[], Iterable[Report]],
        period: float = 1.0,
        hardware_id: str = 'none',
    ) -> None:
        self.hardware_id = hardware_id
        self._node = node
        self._reports = reports
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer: Any = None
        self.set_period(period)

    def set_period(self, period: float) -> None:
        """Change the time between two reports."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._timer = self._node.create_timer(period, self.publish, clock=self._clock)

    def publish(self) -> None:
        """Publish all reports of now."""
        name = self._node.get_fully_qualified_name().lstrip('/')
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [r.message(name, self.hardware_id) for r in self._reports()]
        self._publisher.publish(message)


def _text(value: Any) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)
