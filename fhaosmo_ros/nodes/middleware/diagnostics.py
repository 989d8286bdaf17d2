# SPDX-License-Identifier: Apache-2.0
"""
Reports on /diagnostics, with the conventions of diagnostic_updater.

diagnostic_updater itself is not used, because there is no wheel of it: nothing here could be
tested without an installed ROS. Reports follow the host's steady clock, so that with use_sim_time
they still come when /clock stops.
"""

from collections.abc import Callable, Iterable, Mapping
import re
from time import monotonic
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fhaosmo_ros.nodes.middleware.endpoints import set_period
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE
QUIET, BEGIN = 5.0, 5.0
"""Seconds."""


class Report:
    """One status of /diagnostics, 'node: task': values, findings, and the worst level of these."""

    def __init__(self, task: str, values: Mapping[str, Any] | None = None) -> None:
        self.task, self.level = task, OK
        self.values = dict(values or {})
        self._findings: list[str] = []

    def find(self, level: bytes, text: str, when: object = True) -> None:
        """Add a finding where `when` is true; the status gets the worst level and all texts."""
        if when:
            self.level = max(self.level, level)
            self._findings.append(text)

    @property
    def text(self) -> str:
        """All findings in a line."""
        return '; '.join(self._findings) or 'OK'


def array_of(
    node: Node, stamp: Time, reports: Iterable[Report], hardware_id: str
) -> DiagnosticArray:
    """Return reports of a node as one message."""
    name, message = node.get_fully_qualified_name().lstrip('/'), DiagnosticArray()
    message.header.stamp = stamp
    for report in reports:
        values = [
            KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
            for key, value in report.values.items()
        ]
        message.status.append(DiagnosticStatus(
            level=report.level, name=f'{name}: {report.task}', message=report.text,
            hardware_id=hardware_id, values=values,
        ))  # fmt: skip
    return message


class ReportLog:
    """
    Logs reports that are not OK, each once it says something new, a thing at most every `QUIET` s.

    In the first `BEGIN` seconds these are errors only: publishers and subscriptions need some time
    to find each other.
    """

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        self._begun = monotonic() + BEGIN
        self._latest: dict[str, str] = {}  # by task: what the report before has said
        self._quiet: dict[str, float] = {}  # by what was said: when it may be said again

    def tell(self, reports: Iterable[Report]) -> None:
        """Log those of the present reports that are to be."""
        now = monotonic()
        self._quiet = {said: end for said, end in self._quiet.items() if end > now}
        for report in reports:
            if now < self._begun and report.level != ERROR:
                continue
            text = f'{report.task}: {report.text}'
            kind = re.sub(r'[-+.\d]+', '', text)  # numbers are others each time
            before, self._latest[report.task] = self._latest.get(report.task), kind
            if report.level != OK and kind != before and kind not in self._quiet:
                if report.level == ERROR:
                    self._logger.error(text)
                else:
                    self._logger.warning(text)
                self._quiet[kind] = now + QUIET


class DiagnosticsPublisher:
    """Publishes what `reports` returns each `diagnostics_period` of the host's steady clock."""

    def __init__(
        self, node: Node, reports: Callable[[], Iterable[Report]], values: Mapping[str, Any]
    ) -> None:
        self._node, self._reports, self._hardware_id = node, reports, values['hardware_id']
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(values['diagnostics_period'], self._publish, clock=clock)

    def adopt(self, values: Mapping[str, Any]) -> None:
        """Go on with other values of its parameters."""
        set_period(self._timer, values['diagnostics_period'])
        self._hardware_id = values['hardware_id']

    def _publish(self) -> None:
        """Publish all present reports."""
        stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array_of(self._node, stamp, self._reports(), self._hardware_id))
