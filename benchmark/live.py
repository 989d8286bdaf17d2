# SPDX-License-Identifier: Apache-2.0
"""Processes whose start, CPU time and memory are measured, and what nodes say."""

from collections.abc import Callable, Mapping
from functools import partial
import os
from pathlib import Path
from tempfile import TemporaryDirectory
import threading
from time import monotonic, perf_counter, sleep
from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.endpoints import subscribe_with_info
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.nodes.recording import PrivateNode
from fhaosmo_ros.tools.cli import processes
from fhaosmo_ros.topics import OF_ALL_NODES
import numpy as np
from rclpy.qos import QoSProfile

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0  # seconds that anything may take that is waited for
DIAGNOSTICS = '/diagnostics'

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
    Listens to /diagnostics and to some topics (name and type of each) while it is open.

    All times are source time stamps of the middleware (ns), taken when a message was published, so
    what the listener itself takes does not count. `reports` has the last diagnostics of each node,
    with the time of the report in 'received'; `outputs` and `not_finite` count messages of the
    topics, and those among them with a NaN or an infinity.
    """

    def __init__(self, topics: Mapping[str, str]) -> None:
        super().__init__('watch')
        self.reports: dict[str, dict[str, str]] = {}
        self.outputs = self.not_finite = 0
        self._series: dict[str, list[tuple[int, float]]] = {topic: [] for topic in topics}
        self._lock = threading.Lock()
        qos = QoSProfile(depth=5000)
        for topic, kind in {**topics, DIAGNOSTICS: OF_ALL_NODES[DIAGNOSTICS]}.items():
            take = self._report if topic == DIAGNOSTICS else partial(self._receive, topic)
            subscribe_with_info(self.node, message_class(kind), topic, take, qos)

    def _report(self, message: Any, info: Mapping[str, int]) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            if 'samples accepted' in values:
                node = status.name.partition(': ')[0]
                self.reports[node] = values | {'received': str(info['source_timestamp'])}

    def _receive(self, topic: str, message: Any, info: Mapping[str, int]) -> None:
        if isinstance(message, Time):
            value = message.sec * 1_000_000_000 + message.nanosec
        else:
            value = float(np.sum(message.data))
        self.outputs += 1
        self.not_finite += not np.isfinite(value)
        with self._lock:
            self._series[topic].append((info['source_timestamp'], value))

    def forget(self) -> None:
        """Keep what comes from now on."""
        with self._lock:
            for series in self._series.values():
                series.clear()

    def count(self, topic: str) -> int:
        """Return how many messages have come since `forget`."""
        return len(self._series[topic])

    def series(self, topic: str) -> tuple[Any, Any]:
        """Return times and values since `forget`, in order, as arrays."""
        with self._lock:
            at, values = zip(*sorted(self._series[topic]), strict=True)
        return np.array(at), np.array(values)

    def reported(self, node: str, name: str) -> int:
        """Return a number of a node's last report; 0 where there is none."""
        return int(self.reports.get(node, {}).get(name, 0))

    def taken(self, node: str) -> int:
        """Return the samples of y that a node has used or rejected, by its last report."""
        return self.reported(node, 'samples accepted') + self.reported(node, 'samples rejected')
