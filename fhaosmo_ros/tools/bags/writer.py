# SPDX-License-Identifier: Apache-2.0
"""
Bags written as Jazzy's rosbag2 writes them.

rosbags writes metadata.yaml and sqlite3. Three things of it are changed: the storage file is named
`NAME_0` as by rosbag2, so that `ros2 bag reindex` finds it; the distribution is ROS's, not
rosbags; and messages can be flushed, so that a kill does not take them back.

The mcap package writes mcap: rosbags' own files are refused by rosbag2's C++ reader ('cannot read
MCAP in time order with no message indexes'), as it closes chunks that hold no message.
"""

from collections.abc import Iterator, Sequence
import os
from pathlib import Path
import sqlite3
import struct
from typing import Any, ClassVar, NamedTuple

from fhaosmo_ros.tools.bags.reader import BagReader, MESSAGE, RECORD
from fhaosmo_ros.tools.bags.types import learn, OFFERED_QOS, TYPES
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, MessageDefinitionFormat, Qos
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

DISTRIBUTION = os.environ.get('ROS_DISTRO') or 'jazzy'
VERSION = 9
"""Version of the metadata that Jazzy writes."""
BATCH = 8192
"""Messages that are copied at a time."""
CHUNK_SIZE = 1 << 20
"""Bytes of messages after which a chunk of mcap is closed."""
Columns = Sequence[tuple[Connection, NDArray[np.uint8]]]


class _SqliteFile(Sqlite3Writer):
    def __init__(self, path: Path, _: Any) -> None:
        # Not rosbags' own __init__, which fixes another name of the file.
        self.path = path / f'{path.name}_0.db3'
        self.conn = sqlite3.connect(self.path)
        self.conn.executescript(self.SQLITE_SCHEMA.replace("'rosbags'", f"'{DISTRIBUTION}'"))
        self.cursor = self.conn.cursor()

    def write(self, connection: Connection, stamp: int, data: bytes, _: int = 0) -> None:
        super().write(connection, stamp, data)

    def write_columns(self, times: NDArray[np.int64], columns: Columns) -> None:
        for k, time in enumerate(times.tolist()):
            for connection, messages in columns:
                self.write(connection, time, messages[k].tobytes())

    def flush(self) -> None:
        self.conn.commit()

    def totals(self) -> tuple[dict[int, int], int, int]:
        rows = self.conn.execute(
            'SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages '
            'GROUP BY topic_id'
        ).fetchall()
        first, last = min((r[2] for r in rows), default=0), max((r[3] for r in rows), default=0)
        return {row[0]: row[1] for row in rows}, first, last


class _Index(NamedTuple):
    """Log times and places of a channel's messages in a chunk, written faster than by mcap."""

    channel: int
    entries: NDArray[np.int64]

    def write(self, builder: RecordBuilder) -> None:
        builder.start_record(Opcode.MESSAGE_INDEX)
        builder.write2(self.channel)
        builder.write4(self.entries.nbytes)
        builder.write(self.entries.astype('<i8').tobytes())
        builder.finish_record()


class _McapFile:
    """
    An mcap file, with the methods that rosbags' `Writer` calls.

    The mcap package's `add_message` takes 4 microseconds, and a replay writes five messages for
    each sample. So the messages of a chunk are joined here, and then given to it all at once.
    """

    def __init__(self, path: Path, _: Any) -> None:
        self.path = path / f'{path.name}_0.mcap'
        self._file = self.path.open('xb')
        self._writer = McapWriter(self._file, compression=CompressionType.NONE)
        self._writer.start('ros2', 'fhaosmo_ros')
        self._schemas: dict[str, int] = {}
        self._data = bytearray()  # message records of the chunk that is open
        self._rows: list[tuple[int, int, int]] = []  # their channels, log times and places

    def add_msgtype(self, connection: Connection) -> None:
        definition = connection.msgdef
        encoding = 'ros2msg' if definition.format == MessageDefinitionFormat.MSG else 'ros2idl'
        self._schemas[connection.msgtype] = self._writer.register_schema(
            connection.msgtype, encoding, definition.data.encode()
        )

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        metadata = {
            'offered_qos_profiles': offered_qos_profiles,
            'topic_type_hash': connection.digest,
        }
        schema = self._schemas[connection.msgtype]
        self._writer.register_channel(connection.topic, 'cdr', schema, metadata)

    def write(self, connection: Connection, stamp: int, data: bytes, published: int) -> None:
        self._rows.append((connection.id, stamp, len(self._data)))
        self._data += RECORD.pack(Opcode.MESSAGE, MESSAGE.size + len(data))
        self._data += MESSAGE.pack(connection.id, 0, stamp, published)
        self._data += data
        if len(self._data) > CHUNK_SIZE:
            self._close_chunk()

    def write_columns(self, times: NDArray[np.int64], columns: Columns) -> None:
        self._close_chunk()
        stamps = times.astype('<i8').view(np.uint8).reshape(len(times), -1)
        parts, places, width = [], [], 0
        for connection, messages in columns:
            size = MESSAGE.size + messages.shape[1]
            head = RECORD.pack(Opcode.MESSAGE, size) + struct.pack('<HI', connection.id, 0)
            heads = np.tile(np.frombuffer(head, np.uint8), (len(times), 1))
            parts += [heads, stamps, stamps, messages]
            places.append(width)
            width += RECORD.size + size
        channels = [connection.id for connection, _ in columns]
        starts = width * np.arange(len(times))[:, np.newaxis] + places
        rows = [np.tile(channels, len(times)), np.repeat(times, len(columns)), starts.ravel()]
        self._add(np.hstack(parts).tobytes(), np.column_stack(rows))

    def _close_chunk(self) -> None:
        if self._rows:
            self._add(bytes(self._data), np.array(self._rows, dtype=np.int64))
            self._data, self._rows = bytearray(), []

    def _add(self, data: bytes, rows: NDArray[np.int64]) -> None:
        """Write message records as a chunk: what `Writer.add_message` does for each of them."""
        chunk = self._writer._Writer__chunk_builder
        statistics = self._writer._Writer__statistics
        first, last = int(rows[:, 1].min()), int(rows[:, 1].max())
        rows[:, 2] += chunk.count  # behind new schemas and channels
        for channel in np.unique(rows[:, 0]).tolist():
            entries = rows[rows[:, 0] == channel, 1:]
            chunk.message_indices[channel] = _Index(channel, entries)
            statistics.channel_message_counts[channel] += len(entries)
        chunk.record_writer.write(data)
        chunk.num_messages = len(rows)
        chunk.message_start_time, chunk.message_end_time = first, last
        earlier = statistics.message_start_time if statistics.message_count else first
        statistics.message_start_time = min(first, earlier)
        statistics.message_end_time = max(last, statistics.message_end_time)
        statistics.message_count += len(rows)
        self._writer.flush()

    def flush(self) -> None:
        self._close_chunk()
        self._writer.flush()

    def totals(self) -> tuple[dict[int, int], int, int]:
        self._close_chunk()
        s = self._writer._Writer__statistics
        return dict(s.channel_message_counts), s.message_start_time, s.message_end_time

    def close(self, _: int, metadata: str) -> None:
        self._writer.add_metadata('rosbag2', {'serialized_metadata': metadata})
        self._writer.finish()
        self._file.close()

    def abort(self) -> None:
        self._file.close()


class _Writer(Writer):
    STORAGE_PLUGINS: ClassVar = {
        StoragePlugin.SQLITE3: _SqliteFile,
        StoragePlugin.MCAP: _McapFile,
    }

    def close(self) -> None:
        close = self.storage.close
        self.storage.close = lambda version, text: close(version, _with_distribution(text))
        super().close()
        text = _with_distribution(self.metapath.read_text(encoding='utf-8'))
        part = self.metapath.with_suffix('.part')
        part.write_text(text, encoding='utf-8')
        part.replace(self.metapath)


def _with_distribution(metadata: str) -> str:
    return metadata.replace('ros_distro: rosbags', f'ros_distro: {DISTRIBUTION}')


class BagWriter:
    """
    Writes serialised messages to a bag in the format of Jazzy's rosbag2.

    Parameters
    ----------
    path : path
        Folder to make; it must not exist.
    storage : str
        'mcap' or 'sqlite3'.

    """

    def __init__(self, path: Path, storage: str = 'mcap') -> None:
        plugin = StoragePlugin[storage.upper()]
        self._writer = _Writer(path, version=VERSION, storage_plugin=plugin)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> 'BagWriter':
        self._writer.open()
        return self

    def add(
        self,
        topic: str,
        message_type: str,
        types: Any = TYPES,
        qos: Sequence[Qos] = (OFFERED_QOS,),
        digest: str = '',
    ) -> None:
        """Add a topic if the bag does not have it yet."""
        if topic in self._connections:
            return
        if message_type not in types.fielddefs and types is TYPES:
            learn(message_type)
        if message_type not in types.fielddefs:
            # A type that is not installed, or an old bag without definitions. Readers compare
            # the hash with the definition, so both are those of a message without fields.
            types, digest = get_typestore(Stores.EMPTY), ''
            types.register(get_types_from_msg('', message_type))
        self._connections[topic] = self._writer.add_connection(
            topic,
            message_type,
            msgdef=types.generate_msgdef(message_type, ros_version=2)[0],
            rihs01=digest or types.hash_rihs01(message_type),
            offered_qos_profiles=list(qos),
        )

    def write(self, topic: str, stamp: int, data: bytes, published: int | None = None) -> None:
        """
        Append one message in CDR.

        Parameters
        ----------
        topic : str
        stamp : int
            In nanoseconds.
        data : bytes
        published : int, optional
            Publish time, which mcap keeps beside the stamp; default: the stamp.

        """
        connection = self._connections[topic]
        sent = stamp if published is None else published
        self._writer.storage.write(connection, stamp, data, sent)

    def write_columns(
        self, times: NDArray[np.int64], columns: Sequence[tuple[str, NDArray[np.uint8]]]
    ) -> None:
        """
        Append a message of each topic at each time, all at once.

        Parameters
        ----------
        times : (K,) array of int
            In nanoseconds.
        columns : sequence of (str, (K, size) array)
            Topics, and the bytes of their messages in CDR.

        """
        found = [(self._connections[topic], messages) for topic, messages in columns]
        self._writer.storage.write_columns(times, found)

    def copy(self, reader: BagReader) -> Iterator[None]:
        """Copy every topic as it is; yield now and then, so that the caller can stop."""
        for c in reader.connections:
            self.add(c.topic, c.msgtype, reader.types, *reader.offered(c))
        for k, (topic, stamp, data, published) in enumerate(reader.messages()):
            self.write(topic, stamp, data, published)
            if k % BATCH == 0:
                yield

    def flush(self) -> None:
        """Hand what has been written to the operating system: a later kill cannot take it back."""
        self._writer.storage.flush()

    def __exit__(self, *_: object) -> None:
        writer = self._writer
        counts, writer.min_timestamp, writer.max_timestamp = writer.storage.totals()
        writer.counts |= counts
        writer.close()
