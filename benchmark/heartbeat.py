# SPDX-License-Identifier: Apache-2.0
"""How many samples each node has taken, from what it says on /diagnostics."""

from types import TracebackType

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.nodes.recorder import Recorder
from rclpy.serialization import deserialize_message

TOPIC = '/diagnostics'


class Heartbeat:
    """Listens while it is open."""

    def __init__(self) -> None:
        self._reports: dict[str, list[tuple[int, int]]] = {}
        self._recorder = Recorder({TOPIC: DiagnosticArray}, self._receive)

    def _receive(self, _: str, stamp: int, data: bytes) -> None:
        for status in deserialize_message(data, DiagnosticArray).status:
            values = {item.key: item.value for item in status.values}
            if 'samples accepted' in values:
                report = (stamp, int(values['samples accepted']))
                self._reports.setdefault(status.name.split(':')[0], []).append(report)

    def samples(self, name: str) -> int:
        """Return how many samples a node had taken at its last report."""
        reports = self._reports.get(name)
        return reports[-1][1] if reports else 0

    def forget(self) -> None:
        """Drop the reports so far: a rate is measured from now on."""
        self._reports = {name: reports[-1:] for name, reports in self._reports.items()}

    def rate(self, name: str) -> float:
        """Return the samples a second between the first and the last report, NaN without two."""
        reports = self._reports.get(name, [])
        if len(reports) < 2:
            return float('nan')
        (start, before), (end, after) = reports[0], reports[-1]
        return (after - before) / (end - start) * 1e9

    def __enter__(self) -> 'Heartbeat':
        self._recorder.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._recorder.__exit__(kind, error, trace)
