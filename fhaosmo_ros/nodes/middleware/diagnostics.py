# SPDX-License-Identifier: Apache-2.0
"""
Reports on /diagnostics, with the conventions of diagnostic_updater.

diagnostic_updater itself is not used, because there is no wheel of it: nothing here could be
tested without an installed ROS. Reports follow the host's steady clock, so that with use_sim_time
they still come when /clock stops.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
import re
from time import monotonic
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fhaosmo_ros.nodes.middleware.node import BaseNode
from rclpy.clock import Clock, ClockType

OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE
PERIOD, QUIET, BEGIN = 1.0, 5.0, 5.0
"""Seconds."""


@dataclass
class Report:
    """One status of /diagnostics, 'node: task': values, findings, and the worst level of these."""

    task: str
    values: dict[str, Any] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
    level: bytes = OK

    def find(self, level: bytes, text: str, when: object = True) -> None:
        """Add a finding where `when` is true; the status gets the worst level and all texts."""
        if when:
            self.level = max(self.level, level)
            self.findings.append(text)

    @property
    def text(self) -> str:
        """All findings in a line."""
        return '; '.join(self.findings) or 'OK'


def array_of(node: BaseNode, stamp: Time, reports: Iterable[Report]) -> DiagnosticArray:
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
            hardware_id='none', values=values,
        ))  # fmt: skip
    return message


class ReportLog:
    """
    Logs reports that are not OK, each once it says something new, a thing at most every `QUIET` s.

    In the first `BEGIN` seconds these are errors only: publishers and subscriptions need some time
    to find each other.
    """

    def __init__(self, node: BaseNode) -> None:
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
                if report.level == ERROR:  # rclpy wants a line of its own for each severity
                    self._logger.error(text)
                else:
                    self._logger.warning(text)
                self._quiet[kind] = now + QUIET


def publish_diagnostics(node: BaseNode, reports: Callable[[], Iterable[Report]]) -> None:
    """Publish what `reports` returns, each second of the host's steady clock."""
    publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish() -> None:
        publisher.publish(array_of(node, node.get_clock().now().to_msg(), reports()))

    clock = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(PERIOD, publish, clock=clock)
