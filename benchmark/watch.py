# SPDX-License-Identifier: Apache-2.0
"""What nodes say: numbers, stamps and reports, with the times at which they were published."""

from collections.abc import Iterable
import threading
from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.nodes.recording.topic_recorder import NewTopic, Sample, TopicRecorder
from fhaosmo_ros.topics import OF_ALL_NODES
import numpy as np
from rclpy.serialization import deserialize_message

DIAGNOSTICS = '/diagnostics'


class Watch(TopicRecorder):
    """
    Listens to /diagnostics and to some topics (name and type of each) while it is open.

    All times are source time stamps of the middleware (ns), taken when a message was published, so
    what the listener itself takes does not count.

    Attributes
    ----------
    reports : dict
        The last diagnostics of each node, with the time of the report in 'received'.
    outputs, not_finite : int
        Messages of the topics, and those among them with a NaN or an infinity.

    """

    def __init__(self, topics: Iterable[tuple[str, str]]) -> None:
        self.reports: dict[str, dict[str, str]] = {}
        self.outputs = self.not_finite = 0
        kinds = {**dict(topics), DIAGNOSTICS: OF_ALL_NODES[DIAGNOSTICS]}
        self._classes = {topic: message_class(kind) for topic, kind in kinds.items()}
        self._series: dict[str, list[tuple[int, float]]] = {topic: [] for topic in kinds}
        self._lock = threading.Lock()
        super().__init__(self._receive, lambda topic: topic in kinds)

    def _receive(self, item: NewTopic | Sample) -> None:
        if isinstance(item, NewTopic):
            return
        topic, published, data = item
        message = deserialize_message(data, self._classes[topic])
        if topic == DIAGNOSTICS:
            for status in message.status:
                values = {item.key: item.value for item in status.values}
                if 'samples accepted' in values:
                    node = status.name.partition(': ')[0]
                    self.reports[node] = values | {'received': str(published)}
            return
        if isinstance(message, Time):
            value = message.sec * 1_000_000_000 + message.nanosec
        else:
            value = float(np.sum(message.data))
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

    def series(self, topic: str) -> tuple[Any, Any]:
        """Return times and values since `forget`, in order, as arrays."""
        with self._lock:
            pairs = sorted(self._series[topic])
        return np.array([at for at, _ in pairs]), np.array([value for _, value in pairs])

    def reported(self, node: str, name: str) -> int:
        """Return a number of a node's last report; 0 where there is none."""
        return int(self.reports.get(node, {}).get(name, 0))

    def taken(self, node: str) -> int:
        """Return the samples of y that a node has used or rejected, by its last report."""
        return self.reported(node, 'samples accepted') + self.reported(node, 'samples rejected')
