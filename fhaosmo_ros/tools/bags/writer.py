# SPDX-License-Identifier: Apache-2.0
"""
Bags written as Jazzy's rosbag2 writes them.

rosbags writes metadata.yaml and sqlite3. This module changes three things of it: the storage file
is named `NAME_0` as rosbag2 does, so that `ros2 bag reindex` finds it; the distribution is ROS's,
not rosbags; and messages can be flushed, so that a kill does not take them back. mcap files are
written by mcap/writer.py. `write_chunk` takes the records of a whole chunk and `write_many` many
messages, because rosbags' own call takes 6 microseconds a message.
"""

from collections.abc import Sequence
import os
from pathlib import Path
import sqlite3
from typing import Any, ClassVar

from fhaosmo_ros.tools.bags.mcap.chunks import pack, Records
from fhaosmo_ros.tools.bags.mcap.writer import McapFile
from fhaosmo_ros.tools.bags.types import learn, OFFERED_QOS, TYPES
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

DISTRIBUTION = os.environ.get('ROS_DISTRO') or 'jazzy'
VERSION = 9
"""Version of the metadata that Jazzy writes."""


class _SqliteWriter(Sqlite3Writer):
    def __init__(self, path: Path, _: Any) -> None:
        # Not rosbags' own __init__, which fixes another name of the file.
        self.path = path / f'{path.name}_0.db3'
        self.conn = sqlite3.connect(self.path)
        self.conn.executescript(self.SQLITE_SCHEMA.replace("'rosbags'", f"'{DISTRIBUTION}'"))
        self.cursor = self.conn.cursor()

    def close(self, version: int, metadata: str) -> None:
        super().close(version, _with_distribution(metadata))

    def flush(self) -> None:
        self.conn.commit()


class _McapFile(McapFile):
    def close(self, version: int, metadata: str) -> None:
        super().close(version, _with_distribution(metadata))


class _Writer(Writer):
    STORAGE_PLUGINS: ClassVar = {
        StoragePlugin.SQLITE3: _SqliteWriter,
        StoragePlugin.MCAP: _McapFile,
    }

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
        """Add a topic if the bag does not have it yet; return its channel number."""
        if topic not in self._connections:
            if message_type not in types.fielddefs and types is TYPES:
                learn(message_type)
            if message_type not in types.fielddefs:
                # A type that is not installed, or an old bag without definitions. Readers compare
                # the hash with the definition, so both are those of a message without fields.
                types, digest = get_typestore(Stores.EMPTY), ''
                types.register(get_types_from_msg('', message_type))
            definition = types.generate_msgdef(message_type, ros_version=2)[0]
            digest = digest or types.hash_rihs01(message_type)
            self._connections[topic] = self._writer.add_connection(
                topic,
                message_type,
                msgdef=definition,
                rihs01=digest,
                offered_qos_profiles=list(qos),
            )
        return self._connections[topic].id

    def write(self, topic: str, stamp: int, data: bytes) -> None:
        """Append one message in CDR, with its stamp in nanoseconds."""
        self._writer.write(self._connections[topic], stamp, data)

    def write_many(
        self, ids: Sequence[int], stamps: Sequence[int], texts: Sequence[bytes]
    ) -> None:
        """Append messages in CDR, by channel number, all at once."""
        if not len(ids):
            return
        if self.takes_chunks:
            self.write_chunk(*pack(ids, stamps, texts))
            return
        self._writer.storage.conn.executemany(
            'INSERT INTO messages (topic_id, timestamp, data) VALUES(?, ?, ?)',
            zip(ids, stamps, texts, strict=True),
        )
        self._count(ids, stamps)

    @property
    def count(self) -> int:
        """Return the number of messages so far."""
        return sum(self._writer.counts.values())

    @property
    def takes_chunks(self) -> bool:
        """Return True for an mcap bag."""
        return self._writer.storage_plugin == StoragePlugin.MCAP

    def write_chunk(self, data: NDArray[np.uint8], records: Records) -> None:
        """Append the message records of an mcap chunk as they are, as one chunk."""
        if len(records.times):
            self._writer.storage.write_chunk(data, records)
            self._count(records.channels, records.times)

    def _count(self, ids: Any, stamps: Any) -> None:
        writer = self._writer
        for channel, count in zip(*np.unique(ids, return_counts=True), strict=True):
            writer.counts[int(channel)] += int(count)
        writer.min_timestamp = min(int(np.min(stamps)), writer.min_timestamp)
        writer.max_timestamp = max(int(np.max(stamps)), writer.max_timestamp)

    def flush(self) -> None:
        """Hand what has been written to the operating system: a later kill cannot take it back."""
        self._writer.storage.flush()

    def __exit__(self, *_: object) -> None:
        if not self.count:  # rosbags would begin an empty bag at 2**63 - 1
            self._writer.min_timestamp = self._writer.max_timestamp = 0
        self._writer.close()
