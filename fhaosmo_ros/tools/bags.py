# SPDX-License-Identifier: Apache-2.0
"""Bags written, and read whole; bag_reader.py reads them as a stream."""

from collections.abc import Iterator, Sequence
from io import BytesIO
import os
from pathlib import Path
import re
import struct
from types import TracebackType
from typing import Any, NamedTuple

from fhaosmo_ros.tools.chunks import Records
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
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

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
    Writes serialised messages to a bag in the format of Jazzy's rosbag2.

    Parameters
    ----------
    path : path
        Folder to make; it must not exist.
    topics : dict of str to str
        Message type by topic, such as 'std_msgs/msg/Float64'; `add` adds more.
    storage : str
        'mcap' or 'sqlite3'.

    """

    def __init__(
        self, path: Path, topics: dict[str, str] | None = None, storage: str = 'mcap'
    ) -> None:
        plugin = StoragePlugin[storage.upper()]
        self._writer = Writer(path, version=9, storage_plugin=plugin)
        self._topics = topics or {}
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> 'BagWriter':
        self._writer.open()
        for topic, message_type in self._topics.items():
            self.add(topic, message_type)
        return self

    def add(
        self,
        topic: str,
        message_type: str,
        types: Any = TYPES,
        qos: Sequence[Qos] = (OFFERED_QOS,),
        digest: str = '',
    ) -> int:
        """Add a topic, and return its channel number; once for each topic."""
        if topic not in self._connections:
            if message_type not in types.fielddefs and types is TYPES:
                learn(message_type)
            if message_type not in types.fielddefs:
                # An old bag that does not say what its messages look like. Readers compare the
                # hash with the definition, so it is that of a message without fields.
                types, digest = get_typestore(Stores.EMPTY), ''
                types.register(get_types_from_msg('', message_type))
            definition = types.generate_msgdef(message_type, ros_version=2)[0]
            digest = digest or types.hash_rihs01(message_type)
            self._connections[topic] = self._writer.add_connection(
                topic, message_type, msgdef=definition, rihs01=digest,
                offered_qos_profiles=list(qos),
            )  # fmt: skip
        return self._connections[topic].id

    def write(self, topic: str, stamp: int, data: bytes) -> None:
        """Append one message in CDR, with its stamp in nanoseconds."""
        self._writer.write(self._connections[topic], stamp, data)

    @property
    def count(self) -> int:
        """Number of messages so far."""
        return sum(self._writer.counts.values())

    @property
    def takes_chunks(self) -> bool:
        """True for an mcap bag."""
        return self._writer.storage_plugin == StoragePlugin.MCAP

    def write_chunk(self, data: NDArray[np.uint8], records: Records) -> None:
        """Append message records of an mcap chunk as they are, in one go."""
        if not len(records.times):
            return
        writer, storage = self._writer, self._writer.storage
        self.flush()
        ids, counts = np.unique(records.channels, return_counts=True)
        low, high = int(records.times.min()), int(records.times.max())
        file = storage.bio
        begin = file.tell()
        head = struct.pack('<QQQIIQ', low, high, data.nbytes, 0, 0, data.nbytes)
        file.write(struct.pack('<BQ', 0x06, len(head) + data.nbytes) + head)
        file.write(data.tobytes())
        end = file.tell()
        offsets = b''
        for channel, count in zip(ids.tolist(), counts.tolist(), strict=True):
            offsets += struct.pack('<HQ', channel, file.tell())
            mine = records.channels == channel
            index = np.column_stack([records.times[mine], records.starts[mine]]).astype('<i8')
            file.write(struct.pack('<BQHI', 0x07, 6 + index.nbytes, channel, index.nbytes))
            file.write(index.tobytes())
            storage.channel_stats[channel] += count
            writer.counts[channel] += count
        index = BytesIO()
        index.write(struct.pack('<QQQQI', low, high, begin, end - begin, len(offsets)) + offsets)
        index.write(struct.pack('<QIQQ', file.tell() - end, 0, data.nbytes, data.nbytes))
        storage.chunks.append(index)
        storage.message_start_time = min(low, storage.message_start_time)
        storage.message_end_time = max(high, storage.message_end_time)
        writer.min_timestamp = min(low, writer.min_timestamp)
        writer.max_timestamp = max(high, writer.max_timestamp)

    def flush(self) -> None:
        """Hand what has been written to the system: a later kill can't take it back."""
        storage = self._writer.storage
        if not self.takes_chunks:
            storage.conn.commit()
            return
        if storage.chunk.bio.tell():
            if not storage.chunk.msgs:  # topics only: a chunk without a time
                storage.chunk.message_start_time = 0
            storage.close_chunk()
        storage.bio.flush()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.flush()
        if not self.count:  # an empty bag begins and ends at 0
            self._writer.min_timestamp = self._writer.max_timestamp = 0
            if self.takes_chunks:
                self._writer.storage.message_start_time = 0
        self._writer.close()


def learn(message_type: str) -> bool:
    """Add a type of the sourced workspaces, and those that it uses, to `TYPES` if it is there."""
    if message_type in TYPES.fielddefs:
        return True
    package, kind, name = message_type.split('/')
    for prefix in filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)):
        path = Path(prefix, 'share', package, kind, f'{name}.msg')
        if path.is_file():
            found = get_types_from_msg(path.read_text(encoding='utf-8'), message_type)
            names = re.findall(r"\(<Nodetype.NAME: 2>, '([^']+)'\)", repr(found[message_type]))
            if all(learn(other) for other in names):
                TYPES.register(found)
                return True
    return False


def make_qos(
    history: str, depth: int, reliability: str, durability: str, deadline: int, lifespan: int,
    liveliness: str, liveliness_lease_duration: int,
) -> Qos:  # fmt: skip
    """Return a QoS from its policies' names and its durations in nanoseconds."""
    return Qos(
        QosHistory.__members__.get(history, QosHistory.UNKNOWN), depth,
        QosReliability[reliability], QosDurability[durability],
        QosTime(*divmod(deadline, 10**9)), QosTime(*divmod(lifespan, 10**9)),
        QosLiveliness[liveliness], QosTime(*divmod(liveliness_lease_duration, 10**9)), False,
    )  # fmt: skip


def serialise(message_type: str, **fields: Any) -> bytes:
    """Return a message of one of ROS's own types in CDR."""
    return bytes(TYPES.serialize_cdr(TYPES.types[message_type](**fields), message_type))


def labelled_array(names: list[str], values: NDArray[np.float64]) -> bytes:
    """Return a Float64MultiArray in CDR whose label lists its elements, as the nodes publish."""
    types, count = TYPES.types, len(names)
    dimension = types['std_msgs/msg/MultiArrayDimension'](
        label=','.join(names), size=count, stride=count
    )
    layout = types['std_msgs/msg/MultiArrayLayout'](dim=[dimension], data_offset=0)
    return serialise('std_msgs/msg/Float64MultiArray', layout=layout, data=values)


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
