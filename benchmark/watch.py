# SPDX-License-Identifier: Apache-2.0
"""What nodes say: samples taken, when they published, which sample that contained."""

import struct
from types import TracebackType
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.nodes.recording.topic_recorder import ExpectedTopic, Sample, TopicRecorder
from fhaosmo_ros.topics import OF_ALL_NODES, TIME
import numpy as np
from rclpy.serialization import deserialize_message

DIAGNOSTICS = '/diagnostics'
CDR_TIME = struct.Struct('<4xiI')
NANOSECONDS = 1e-9


class Quantiles(NamedTuple):
    """Of absolute values, in seconds; NaN without any."""

    median: float
    p99: float
    largest: float


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
                node, _, what = status.name.partition(': ')  # what: [channel] input
                for name in (node, f'{node}/{what.split()[0]}'):
                    self._reports[name] = published, taken

    def report(self, name: str) -> tuple[int, int]:
        """Return when a node or NODE/CHANNEL reported last (ns), and the samples taken so far."""
        return self._reports.get(name, (0, 0))

    def forget(self) -> None:
        """Measure from now on."""
        for pairs in self._pairs.values():
            pairs.clear()

    def count(self, name: str) -> int:
        """Return how many estimates a node has published since `forget`."""
        return len(self._pairs[f'/{name}/stamp'])

    def jitter(self, name: str, rate: float) -> Quantiles:
        """Return the deviation of the time between two publications from 1 / rate."""
        return _quantiles(np.diff(self._columns(name)[0]) * NANOSECONDS - 1.0 / rate)

    def latency(self, name: str) -> Quantiles:
        """Return the time from a sample's publication to that of the first estimate with it."""
        published, sample = self._columns(name)
        _, first = np.unique(sample, return_index=True)
        return _quantiles((published - sample)[first] * NANOSECONDS)

    def _columns(self, name: str) -> np.ndarray:
        pairs = sorted(self._pairs[f'/{name}/stamp'])
        return np.array(pairs, dtype=np.int64).reshape(-1, 2).T

    def __enter__(self) -> 'Watch':
        self._recorder.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._recorder.__exit__(kind, error, trace)


def _quantiles(values: np.ndarray) -> Quantiles:
    if not len(values):
        return Quantiles(*[float('nan')] * 3)
    return Quantiles(*np.quantile(np.abs(values), [0.5, 0.99, 1.0]).tolist())
