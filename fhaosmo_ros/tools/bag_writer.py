# SPDX-License-Identifier: Apache-2.0
"""Bags written as Jazzy's rosbag2 writes them: by rosbags, with what it leaves out."""

from collections.abc import Sequence
from io import BytesIO
import os
from pathlib import Path
import struct
from types import TracebackType
from typing import Any, ClassVar

from fhaosmo_ros.tools.bags import learn, OFFERED_QOS, TYPES
from fhaosmo_ros.tools.chunks import DATA_AT, MESSAGE, Records
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import Channel, McapWriter, write_channel
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

DISTRIBUTION = os.environ.get('ROS_DISTRO') or 'jazzy'
MESSAGE_HEAD = struct.Struct('<BQHIQQ')
VERSION = 9
"""Of Jazzy's metadata."""


class _McapWriter(McapWriter):
    """With the hash of the type in each channel, as rosbag2 has it."""

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        pairs = {
            'offered_qos_profiles': offered_qos_profiles,
            'topic_type_hash': connection.digest,
        }
        texts = [text.encode() for pair in pairs.items() for text in pair]
        metadata = b''.join(struct.pack('<I', len(text)) + text for text in texts)
        channel = Channel(
            connection.id, connection.msgtype, connection.topic,
            connection.ext.serialization_format, metadata,
        )  # fmt: skip
        self.channels.append(channel)
        self.channel_stats[connection.id] = 0
        write_channel(self.chunk.bio, channel, self.schemas)

    def close(self, version: int, metadata: str) -> None:
        super().close(version, _with_distribution(metadata))


class _SqliteWriter(Sqlite3Writer):
    SQLITE_SCHEMA = Sqlite3Writer.SQLITE_SCHEMA.replace("'rosbags'", f"'{DISTRIBUTION}'")

    def close(self, version: int, metadata: str) -> None:
        super().close(version, _with_distribution(metadata))


class _Writer(Writer):
    STORAGE_PLUGINS: ClassVar = {
        StoragePlugin.SQLITE3: _SqliteWriter, StoragePlugin.MCAP: _McapWriter,
    }  # fmt: skip

    def close(self) -> None:
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
    ) -> int:
        """Add a topic, such as of 'std_msgs/msg/Float64', once; return its channel number."""
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

    def write_many(
        self, ids: Sequence[int], stamps: Sequence[int], texts: Sequence[bytes]
    ) -> None:
        """Append messages in CDR, by channel number, in one go."""
        if not len(ids):
            return
        if self.takes_chunks:
            heads = [
                MESSAGE_HEAD.pack(MESSAGE, 22 + len(text), channel, 0, stamp, stamp)
                for channel, stamp, text in zip(ids, stamps, texts, strict=True)
            ]
            data = b''.join([part for pair in zip(heads, texts, strict=True) for part in pair])
            ends = np.cumsum([DATA_AT + len(text) for text in texts])
            starts = np.concatenate([[0], ends[:-1]])
            records = Records(np.array(stamps), np.array(ids), starts, ends)
            self.write_chunk(np.frombuffer(data, dtype=np.uint8), records)
            return
        self._writer.storage.conn.executemany(
            'INSERT INTO messages (topic_id, timestamp, data) VALUES(?, ?, ?)',
            zip(ids, stamps, texts, strict=True),
        )
        for channel, count in zip(*np.unique(ids, return_counts=True), strict=True):
            self._writer.counts[int(channel)] += int(count)
        self._writer.min_timestamp = min(min(stamps), self._writer.min_timestamp)
        self._writer.max_timestamp = max(max(stamps), self._writer.max_timestamp)

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
