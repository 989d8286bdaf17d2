# SPDX-License-Identifier: Apache-2.0
"""What nodes say: samples taken, when they published, which sample that contained."""

import struct
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.nodes.recording.topic_recorder import ExpectedTopic, Sample, TopicRecorder
from fhaosmo_ros.topics import OF_ALL_NODES, TIME
import numpy as np
from rclpy.serialization import deserialize_message

DIAGNOSTICS = '/diagnostics'
CDR_TIME = struct.Struct('<4xiI')


class Watch:
    """
    Listens to /diagnostics, and to ``/NAME/stamp`` of each named node, while it is open.

    All times are source time stamps of the middleware, taken when a message was published, so what
    the listener itself takes does not count.
    """

    def __init__(self, names: list[str]) -> None:
        self._pairs: dict[str, list[tuple[int, int]]] = {f'/{name}/stamp': [] for name in names}
        self._reports: dict[str, tuple[int, int]] = {}
        expected = [ExpectedTopic(topic, TIME) for topic in self._pairs]
        expected.append(ExpectedTopic(DIAGNOSTICS, OF_ALL_NODES[DIAGNOSTICS]))
        self._recorder = TopicRecorder(self._receive, expected)

    def _receive(self, sample: Sample) -> None:
        topic, published, data = sample
        if topic != DIAGNOSTICS:
            seconds, nanoseconds = CDR_TIME.unpack(data)
            self._pairs[topic].append((published, seconds * 1_000_000_000 + nanoseconds))
            return
        for status in deserialize_message(data, DiagnosticArray).status:
            values = {item.key: item.value for item in status.values}
            if 'samples accepted' in values:
                taken = int(values['samples accepted']) + int(values.get('samples rejected', 0))
                self._reports[status.name.partition(': ')[0]] = published, taken

    def report(self, name: str) -> tuple[int, int]:
        """Return when a node reported last (ns), and the samples taken so far."""
        return self._reports.get(name, (0, 0))

    def forget(self) -> None:
        """Measure from now on."""
        for pairs in self._pairs.values():
            pairs.clear()

    def count(self, name: str) -> int:
        """Return how many estimates a node has published since `forget`."""
        return len(self._pairs[f'/{name}/stamp'])

    def latency(self, name: str) -> tuple[float, float]:
        """Return the time (s) from a sample's publication to its first estimate: median, 99 %."""
        pairs = sorted(self._pairs[f'/{name}/stamp'])
        published, sample = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        _, first = np.unique(sample, return_index=True)
        late = 1e-9 * np.abs(published - sample)[first]
        median, most = np.quantile(late, [0.5, 0.99]) if len(late) else (np.nan, np.nan)
        return float(median), float(most)

    def __enter__(self) -> 'Watch':
        self._recorder.__enter__()
        return self

    def __exit__(self, *reason: Any) -> None:
        self._recorder.__exit__(*reason)
