# SPDX-License-Identifier: Apache-2.0
"""What nodes say: numbers, stamps and reports, with the times at which they were published."""

from collections.abc import Mapping
import struct
import threading
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.nodes.recording.topic_recorder import ExpectedTopic, Sample, TopicRecorder
from fhaosmo_ros.topics import ARRAY, FLOAT, OF_ALL_NODES, TIME
import numpy as np
from rclpy.serialization import deserialize_message
from std_msgs.msg import Float64MultiArray

DIAGNOSTICS = '/diagnostics'
CDR_DOUBLE, CDR_TIME = struct.Struct('<4xd'), struct.Struct('<4xiI')


class Watch:
    """
    Listens to /diagnostics and to some topics while it is open.

    All times are source time stamps of the middleware (ns), taken when a message was published, so
    what the listener itself takes does not count.

    Parameters
    ----------
    topics : mapping
        Types of messages by topic: a number, a stamp or an array, of which only is kept whether
        it is finite.

    Attributes
    ----------
    reports : dict
        The last diagnostics of each node, with the time of the report in 'received'.
    outputs, not_finite : int
        Numbers and arrays received, and those among them with a NaN or an infinity.

    """

    def __init__(self, topics: Mapping[str, str]) -> None:
        self.reports: dict[str, dict[str, str]] = {}
        self.outputs = self.not_finite = 0
        self._types = topics
        self._series: dict[str, list[tuple[int, float]]] = {topic: [] for topic in topics}
        self._lock = threading.Lock()
        expected = [ExpectedTopic(topic, kind) for topic, kind in topics.items()]
        expected.append(ExpectedTopic(DIAGNOSTICS, OF_ALL_NODES[DIAGNOSTICS]))
        self._recorder = TopicRecorder(self._receive, expected)

    def _receive(self, sample: Sample) -> None:
        topic, published, data = sample
        if topic == DIAGNOSTICS:
            for status in deserialize_message(data, DiagnosticArray).status:
                values = {item.key: item.value for item in status.values}
                if 'samples accepted' in values:
                    node = status.name.partition(': ')[0]
                    self.reports[node] = values | {'received': str(published)}
            return
        kind = self._types[topic]
        if kind == ARRAY:
            value = float(np.sum(deserialize_message(data, Float64MultiArray).data))
        elif kind == FLOAT:
            value = CDR_DOUBLE.unpack(data)[0]
        else:
            assert kind == TIME, kind
            seconds, nanoseconds = CDR_TIME.unpack(data)
            value = seconds * 1_000_000_000 + nanoseconds
        self.outputs += 1
        self.not_finite += not np.isfinite(value)
        with self._lock:
            self._series[topic].append((published, value))

    def forget(self) -> None:
        """Keep what comes from now on."""
        with self._lock:
            for series in self._series.values():
                series.clear()

    def count(self, topic: str) -> int:
        """Return how many messages have come since `forget`."""
        return len(self._series[topic])

    def series(self, topic: str) -> tuple[np.ndarray, np.ndarray]:
        """Return times and values since `forget`, in order."""
        with self._lock:
            pairs = sorted(self._series[topic])
        return np.array([at for at, _ in pairs]), np.array([value for _, value in pairs])

    def taken(self, node: str) -> int:
        """Return the samples of y that a node has used or rejected, by its last report."""
        report = self.reports[node]
        return int(report['samples accepted']) + int(report.get('samples rejected', 0))

    def reported_after(self, node: str, time: int) -> bool:
        """Return True once a node has reported after a time (ns)."""
        return int(self.reports.get(node, {}).get('received', 0)) > time

    def __enter__(self) -> 'Watch':
        self._recorder.__enter__()
        return self

    def __exit__(self, *reason: Any) -> None:
        self._recorder.__exit__(*reason)
