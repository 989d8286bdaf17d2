# SPDX-License-Identifier: Apache-2.0
"""
Bags written as Jazzy's rosbag2 writes them.

rosbags writes metadata.yaml and sqlite3. Three things of it are changed: the storage file is named
`NAME_0` as by rosbag2, so that `ros2 bag reindex` finds it; the distribution is ROS's, not
rosbags; and messages can be flushed, so that a kill does not take them back. mcap files are
written by mcap_file.py.
"""

from collections.abc import Iterator, Sequence
import os
from pathlib import Path
import sqlite3
from typing import Any, ClassVar

from fhaosmo_ros.tools.bags.mcap_file import McapFile
from fhaosmo_ros.tools.bags.reader import BagReader
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
BATCH = 8192
"""Messages that are copied at a time."""


def _with_distribution(metadata: str) -> str:
    return metadata.replace('ros_distro: rosbags', f'ros_distro: {DISTRIBUTION}')


class _SqliteFile(Sqlite3Writer):
    def __init__(self, path: Path, _: Any) -> None:
        # Not rosbags' own __init__, which fixes another name of the file.
        self.path = path / f'{path.name}_0.db3'
        self.conn = sqlite3.connect(self.path)
        self.conn.executescript(self.SQLITE_SCHEMA.replace("'rosbags'", f"'{DISTRIBUTION}'"))
        self.cursor = self.conn.cursor()

    def write(self, connection: Connection, stamp: int, data: bytes, _: int) -> None:
        super().write(connection, stamp, data)

    def write_columns(
        self, times: NDArray[np.int64], columns: Sequence[tuple[Connection, NDArray[np.uint8]]]
    ) -> None:
        for k, time in enumerate(times.tolist()):
            for connection, messages in columns:
                super().write(connection, time, messages[k].tobytes())

    def flush(self) -> None:
        self.conn.commit()

    def totals(self) -> tuple[dict[int, int], int, int]:
        rows = self.conn.execute(
            'SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages '
            'GROUP BY topic_id'
        ).fetchall()
        first, last = min((r[2] for r in rows), default=0), max((r[3] for r in rows), default=0)
        return {row[0]: row[1] for row in rows}, first, last


class _Writer(Writer):
    STORAGE_PLUGINS: ClassVar = {
        StoragePlugin.SQLITE3: _SqliteFile,
        StoragePlugin.MCAP: McapFile,
    }

    def close(self) -> None:
        close = self.storage.close
        self.storage.close = lambda version, text: close(version, _with_distribution(text))
        super().close()
        text = _with_distribution(self.metapath.read_text(encoding='utf-8'))
        part = self.metapath.with_suffix('.part')
        part.write_text(text, encoding='utf-8')
        part.replace(self.metapath)


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
