# SPDX-License-Identifier: Apache-2.0
"""Bags: the only module that imports rosbags."""

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)
FOREVER = QosTime(sec=9223372036, nsec=854775807)
"""How rosbag2 writes an unlimited duration."""
OFFERED_QOS = Qos(
    QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE,
    FOREVER, FOREVER, QosLiveliness.AUTOMATIC, FOREVER, False,
)  # fmt: skip
"""What this package's nodes offer; `ros2 bag play` publishes with it again."""


class BagWriter:
    """
    Writes serialised messages to an mcap bag in the format of Jazzy's rosbag2.

    Parameters
    ----------
    path : path
        Folder to make; it must not exist.
    topics : dict of str to str
        Message type by topic, such as 'std_msgs/msg/Float64'.

    """

    def __init__(self, path: Path, topics: dict[str, str]) -> None:
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._topics = topics
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> 'BagWriter':
        self._writer.open()
        for topic, message_type in self._topics.items():
            self._connections[topic] = self._writer.add_connection(
                topic, message_type, typestore=TYPES, offered_qos_profiles=[OFFERED_QOS]
            )
        return self

    def write(self, topic: str, stamp: int, data: bytes) -> None:
        """Append one message in CDR, with its stamp in nanoseconds."""
        self._writer.write(self._connections[topic], stamp, data)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()


class Series(NamedTuple):
    """
    A topic's messages as arrays.

    Attributes
    ----------
    stamps : (K,) array of int
        Stamps in nanoseconds.
    values : (K,) or (K, n) array
        Numbers of a Float64, a Float64MultiArray, or a Time (in nanoseconds, as integers).
    labels : list of str
        Names of the n columns, where the messages have a label.

    """

    stamps: NDArray[np.int64]
    values: NDArray[Any]
    labels: list[str]


def messages(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield a topic's stamps (ns) and messages in the order of the bag."""
    with AnyReader([path], default_typestore=TYPES) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        if not connections:
            return
        for connection, stamp, data in reader.messages(connections=connections):
            yield stamp, reader.deserialize(data, connection.msgtype)


def series(path: Path, topic: str) -> Series:
    """Read a topic of numbers; empty arrays if it has no message."""
    stamps, values, labels = [], [], []
    for stamp, message in messages(path, topic):
        stamps.append(stamp)
        if hasattr(message, 'nanosec'):
            values.append(message.sec * 1_000_000_000 + message.nanosec)
        else:
            values.append(message.data)
            layout = getattr(message, 'layout', None)
            if layout is not None and layout.dim:
                labels = layout.dim[0].label.split(',')
    return Series(np.array(stamps, dtype=np.int64), np.array(values), labels)
