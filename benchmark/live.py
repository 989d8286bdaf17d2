# SPDX-License-Identifier: Apache-2.0
"""Processes whose start, CPU time and memory are measured, and what nodes say."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import partial
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, perf_counter, sleep
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.endpoints import subscribe_with_info
from fhaosmo_ros.nodes.recording import PrivateNode
from fhaosmo_ros.tools.cli import processes
from rclpy.qos import QoSProfile

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0  # seconds that anything may take that is waited for

# What is started here is kept away from other ROS systems; the tests use the domains from 20 on.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
own = os.environ.setdefault('BENCHMARK_DOMAIN', str(1 + os.getpid() % 19))
os.environ['ROS_DOMAIN_ID'] = own  # its children's, too


def wait_until(condition: Callable[[], Any], complaint: str, poll: float = 0.02) -> None:
    """Wait for a condition; raise with a complaint if it does not come."""
    deadline = monotonic() + PATIENCE
    while not condition():
        if monotonic() > deadline:
            raise ConfigurationError(f'{complaint} within {PATIENCE:g} s')
        sleep(poll)


class Child(processes.Child):
    """A child in a session of its own: Ctrl-C reaches only us, and we end the children."""

    def __init__(self, name: str, *arguments: str) -> None:
        self.started = perf_counter()
        self._folder = TemporaryDirectory()
        log = Path(self._folder.name, f'{name}.log')
        environment = {**os.environ, 'PYTHONUNBUFFERED': '1'}
        super().__init__(log, *arguments, env=environment, start_new_session=True, cwd=ROOT)

    def __exit__(self, *reason: Any) -> None:
        super().__exit__(*reason)
        self._folder.cleanup()

    def wait_for(self, text: str) -> float:
        """Wait until `text` is in the output; return the seconds since the start."""

        def said() -> bool:
            self.check()
            return text in self.output()

        wait_until(said, f"{self._log.stem} did not say '{text}'", 0.002)
        return perf_counter() - self.started

    def cpu_seconds(self) -> float:
        """Return the CPU time used so far, in user and kernel mode, of all threads."""
        fields = Path(f'/proc/{self.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def resident_megabytes(self) -> float:
        """Return the memory that the child occupies now."""
        pages = int(Path(f'/proc/{self.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def start_node(name: str, *arguments: str) -> Child:
    """Start one of this package's nodes."""
    return Child(name, '-m', 'fhaosmo_ros', name, *arguments)


class Watch(PrivateNode):
    """
    Hears topics (the type of each), and the diagnostics of all nodes.

    `heard` has by topic what has come: each message behind its source time stamp (ns), taken when
    it was published, so what the listener itself takes does not count. `reports` has the latest
    values of each node, with the time of the report in 'received'.
    """

    def __init__(self, topics: Mapping[str, type]) -> None:
        super().__init__('watch')
        self.heard: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in topics}
        self.reports: dict[str, dict[str, str]] = defaultdict(dict)
        for topic, kind in {**topics, '/diagnostics': DiagnosticArray}.items():
            take = partial(self._receive, topic) if topic in topics else self._report
            subscribe_with_info(self.node, kind, topic, take, QoSProfile(depth=5000))

    def _report(self, message: DiagnosticArray, info: Mapping[str, int]) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            values['received'] = str(info['source_timestamp'])
            self.reports[status.name.partition(': ')[0]].update(values)

    def _receive(self, topic: str, message: Any, info: Mapping[str, int]) -> None:
        self.heard[topic].append((info['source_timestamp'], message))

    def forget(self) -> None:
        """Keep what comes from now on."""
        for topic in self.heard:
            self.heard[topic] = []

    def number(self, node: str, *names: str) -> int:
        """Return a number of a node's latest report, or the sum of some; 0 before it has come."""
        return sum(int(self.reports[node].get(name, 0)) for name in names)
