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
NUMBER = re.compile(r'[-+.\d]+(e[-+]\d+)?')


@dataclass
class Report:
    """One status of /diagnostics, 'node: task': values, findings, and the worst level of these."""

    task: str
    values: dict[str, Any] = field(default_factory=dict)
    findings: list[tuple[bytes, str]] = field(default_factory=list)

    def find(self, level: bytes, text: str, when: object = True) -> None:
        """Add a finding where `when` is true; the status gets the worst level and all texts."""
        if when:
            self.findings.append((level, text))

    @property
    def level(self) -> bytes:
        """The worst level of the findings."""
        return max((level for level, _ in self.findings), default=OK)

    @property
    def text(self) -> str:
        """All findings in a line."""
        return '; '.join(text for _, text in self.findings) or 'OK'


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
    Logs findings that are not OK, each once, and again after `QUIET` seconds without it.

    In the first `begin` seconds these are errors only: publishers and subscriptions need some time
    to find each other.
    """

    def __init__(self, node: BaseNode, begin: float = 0.0) -> None:
        self._node, self._begun = node, monotonic() + begin
        self._found: dict[str, float] = {}  # when each thing was found last

    def tell(self, reports: Iterable[Report]) -> None:
        """Log what is new in the present reports."""
        now, log = monotonic(), self._node.get_logger()
        self._found = {kind: at for kind, at in self._found.items() if now - at < QUIET}
        for report in reports:
            for level, finding in report.findings:
                if level == OK or (now < self._begun and level != ERROR):
                    continue
                text = f'{report.task}: {finding}'
                kind = NUMBER.sub('', text)  # numbers are others each time
                new = kind not in self._found
                self._found[kind] = now
                if new and level == ERROR:  # rclpy wants a line of its own for each severity
                    log.error(text)
                elif new:
                    log.warning(text)


def publish_diagnostics(node: BaseNode, reports: Callable[[], Iterable[Report]]) -> None:
    """Publish what `reports` returns, each second of the host's steady clock."""
    publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish() -> None:
        publisher.publish(array_of(node, node.get_clock().now().to_msg(), reports()))

    clock = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(PERIOD, publish, clock=clock)
