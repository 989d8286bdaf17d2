# SPDX-License-Identifier: Apache-2.0
"""Listens to a soak: every output must be finite; the judged seconds are kept."""

import struct
import threading
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.nodes.recording.topic_recorder import ExpectedTopic, Sample, TopicRecorder
from fhaosmo_ros.topics import ARRAY, FLOAT, OF_ALL_NODES, TIME
import numpy as np
from rclpy.serialization import deserialize_message
from std_msgs.msg import Float64MultiArray

TRUTH = '/plant/unknown_input'
ESTIMATE = '/estimator/unknown_input'
GAMMA = '/estimator/gamma'
STAMP = '/estimator/stamp'
ARRAYS = ('/estimator/state', '/estimator/innovation')
DIAGNOSTICS = '/diagnostics'
TOPICS = [
    *(ExpectedTopic(topic, FLOAT) for topic in (TRUTH, ESTIMATE, GAMMA)),
    *(ExpectedTopic(topic, ARRAY) for topic in ARRAYS),
    ExpectedTopic(STAMP, TIME),
    ExpectedTopic(DIAGNOSTICS, OF_ALL_NODES[DIAGNOSTICS]),
]
CDR_DOUBLE = struct.Struct('<4xd')
CDR_TIME = struct.Struct('<4xiI')
PAIRED = 5_000_000
"""Nanoseconds within which the topics of one estimate are published."""


class SoakWatch:
    """
    Listens while it is open.

    Attributes
    ----------
    outputs, not_finite : int
        Estimates received, and those among them with a NaN or an infinity.
    report : dict of str to str
        The estimator's last diagnostics, with the time of the report in 'received' (ns).

    """

    def __init__(self) -> None:
        self.outputs = self.not_finite = 0
        self.report: dict[str, str] = {}
        self._kept: dict[str, list[tuple[int, float]]] | None = None
        self._lock = threading.Lock()
        self._recorder = TopicRecorder(self._receive, TOPICS)

    def _receive(self, sample: Sample) -> None:
        topic, published, data = sample
        if topic == DIAGNOSTICS:
            for status in deserialize_message(data, DiagnosticArray).status:
                values = {item.key: item.value for item in status.values}
                if 'samples accepted' in values:
                    self.report = values | {'received': str(published)}
            return
        if topic in ARRAYS:
            values = deserialize_message(data, Float64MultiArray).data
            self._check(bool(np.isfinite(values).all()))
            return
        if topic == STAMP:
            seconds, nanoseconds = CDR_TIME.unpack(data)
            value = seconds * 1_000_000_000 + nanoseconds
        else:
            value = CDR_DOUBLE.unpack(data)[0]
            if topic != TRUTH:
                self._check(bool(np.isfinite(value)))
        with self._lock:
            if self._kept is not None:
                self._kept.setdefault(topic, []).append((published, value))

    def _check(self, finite: bool) -> None:
        self.outputs += 1
        self.not_finite += not finite

    def keep(self) -> None:
        """Keep what comes from now on."""
        with self._lock:
            self._kept = {}

    def judge(self) -> tuple[float, float]:
        """
        Return what was kept since `keep`, and keep no more.

        Returns
        -------
        (float, float)
            Medians of the absolute error of d (a busy machine delays single samples) and of gamma;
            NaN without estimates.

        """
        with self._lock:
            kept, self._kept = self._kept or {}, None
        if not all(kept.get(topic) for topic in (TRUTH, ESTIMATE, GAMMA, STAMP)):
            return float('nan'), float('nan')
        published, d = zip(*sorted(kept[ESTIMATE]), strict=True)
        times, stamps = np.array(sorted(kept[STAMP])).T
        after = np.minimum(np.searchsorted(times, published), len(times) - 1)
        paired = np.abs(times[after] - np.array(published)) < PAIRED
        at, truth = zip(*sorted(kept[TRUTH]), strict=True)
        origin = at[0]
        t = (stamps[after] - origin)[paired]
        d_true = np.interp(t, np.array(at) - origin, truth)
        error = np.median(np.abs(np.array(d)[paired] - d_true))
        return float(error), float(np.median([value for _, value in kept[GAMMA]]))

    def __enter__(self) -> 'SoakWatch':
        self._recorder.__enter__()
        return self

    def __exit__(self, *reason: Any) -> None:
        self._recorder.__exit__(*reason)
