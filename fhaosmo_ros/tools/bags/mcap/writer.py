# SPDX-License-Identifier: Apache-2.0
"""
The storage file of an mcap bag, as Jazzy's rosbag2 reads it.

rosbags' own file is not used. It puts schemas and channels into chunks, and a chunk that is closed
before the first message has no message index: the C++ reader (mcap 1.3.0) then refuses the whole
file with 'cannot read MCAP in time order with no message indexes'. It also writes no CRC, no hash
of the types, and takes one message a call (6 us).
"""

from importlib.metadata import version
from pathlib import Path
import struct
from typing import Any
from zlib import crc32

from fhaosmo_ros.tools.bags.mcap.chunks import Bytes, CHUNK, MESSAGE, MESSAGE_HEAD, Records
import numpy as np
from rosbags.interfaces import Connection, MessageDefinitionFormat

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL = 0x01, 0x02, 0x03, 0x04
MESSAGE_INDEX, CHUNK_INDEX = 0x07, 0x08
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F
"""Opcodes of the records."""
CHUNK_SIZE = 1 << 20
"""Bytes of messages after which a chunk is closed."""


def record(opcode: int, content: bytes) -> bytes:
    """Return a record: opcode, length and content."""
    return struct.pack('<BQ', opcode, len(content)) + content


def text(value: str) -> bytes:
    """Return a string as mcap stores it, behind its length."""
    data = value.encode()
    return struct.pack('<I', len(data)) + data


class McapFile:
    """
    An mcap file that is written, with the methods that rosbags' `Writer` calls.

    Schemas and channels lie outside the chunks, before the first chunk that uses them, and again
    in the summary. Every chunk holds messages, has a CRC, and is followed by its message indexes.

    Parameters
    ----------
    path : path
        Folder of the bag.
    _ : object
        Compression mode of rosbags; the file is written without.

    """

    def __init__(self, path: Path, _: Any = None) -> None:
        self.path = path / f'{path.name}_0.mcap'
        self._file = self.path.open('xb')
        library = text(f'fhaosmo_ros, rosbags-{version("rosbags")}')
        self._file.write(MAGIC + record(HEADER, text('ros2') + library))
        self._schemas: dict[str, bytes] = {}
        self._channels: list[bytes] = []
        self._chunk_indexes: list[bytes] = []
        self._counts: dict[int, int] = {}
        self._first, self._last = 2**63 - 1, 0
        self._pending = bytearray()
        self._rows: list[tuple[int, int, int, int]] = []  # of the messages in `_pending`

    def add_msgtype(self, connection: Connection) -> None:
        """Write the definition of a type."""
        is_msg = connection.msgdef.format == MessageDefinitionFormat.MSG
        schema = record(
            SCHEMA,
            struct.pack('<H', len(self._schemas) + 1)
            + text(connection.msgtype)
            + text('ros2msg' if is_msg else 'ros2idl')
            + text(connection.msgdef.data),
        )
        self._schemas[connection.msgtype] = schema
        self._file.write(schema)

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Write a topic with its QoS and the hash of its type."""
        schema = list(self._schemas).index(connection.msgtype) + 1
        metadata = text('offered_qos_profiles') + text(offered_qos_profiles)
        metadata += text('topic_type_hash') + text(connection.digest)
        channel = record(
            CHANNEL,
            struct.pack('<HH', connection.id, schema)
            + text(connection.topic)
            + text(connection.ext.serialization_format)
            + struct.pack('<I', len(metadata))
            + metadata,
        )
        self._channels.append(channel)
        self._counts[connection.id] = 0
        self._file.write(channel)

    def write(self, connection: Connection, stamp: int, data: bytes) -> None:
        """Append one message in CDR."""
        start, channel = len(self._pending), connection.id
        self._pending += MESSAGE_HEAD.pack(MESSAGE, 22 + len(data), channel, 0, stamp, stamp)
        self._pending += data
        self._rows.append((stamp, channel, start, len(self._pending)))
        if len(self._pending) > CHUNK_SIZE:
            self._close_chunk()

    def write_chunk(self, data: Bytes, records: Records) -> None:
        """Append message records, behind those that are still held back, as one chunk."""
        self._close_chunk()
        self._append_chunk(data, records)

    def flush(self) -> None:
        """Hand all messages so far to the operating system."""
        self._close_chunk()
        self._file.flush()

    def _close_chunk(self) -> None:
        if self._rows:
            data = np.frombuffer(bytes(self._pending), dtype=np.uint8)
            records = Records(*np.array(self._rows, dtype=np.int64).T)
            self._pending, self._rows = bytearray(), []
            self._append_chunk(data, records)

    def _append_chunk(self, data: Bytes, records: Records) -> None:
        low, high = int(records.times.min()), int(records.times.max())
        begin = self._file.tell()
        # Without compression: the name of it is empty, and both sizes are the same.
        head = struct.pack('<QQQIIQ', low, high, data.nbytes, crc32(data), 0, data.nbytes)
        self._file.write(struct.pack('<BQ', CHUNK, len(head) + data.nbytes) + head)
        self._file.write(data)
        end, offsets = self._file.tell(), b''
        for channel in np.unique(records.channels).tolist():
            mine = records.channels == channel
            index = np.column_stack([records.times[mine], records.starts[mine]]).astype('<i8')
            offsets += struct.pack('<HQ', channel, self._file.tell())
            content = struct.pack('<HI', channel, index.nbytes) + index.tobytes()
            self._file.write(record(MESSAGE_INDEX, content))
            self._counts[channel] += len(index)
        content = struct.pack('<QQQQI', low, high, begin, end - begin, len(offsets)) + offsets
        content += struct.pack('<QIQQ', self._file.tell() - end, 0, data.nbytes, data.nbytes)
        self._chunk_indexes.append(record(CHUNK_INDEX, content))
        self._first, self._last = min(low, self._first), max(high, self._last)

    def close(self, _: int, metadata: str) -> None:
        """Write the bag's metadata, the summary and the footer."""
        self._close_chunk()
        begin = self._file.tell()
        pair = text('serialized_metadata') + text(metadata)
        content = record(METADATA, text('rosbag2') + struct.pack('<I', len(pair)) + pair)
        self._file.write(content)
        place = struct.pack('<QQ', begin, len(content)) + text('rosbag2')
        self._file.write(record(DATA_END, bytes(4)))
        counts = b''.join(struct.pack('<HQ', *pair) for pair in sorted(self._counts.items()))
        statistics = struct.pack(
            '<QHIIIIQQI',
            sum(self._counts.values()),
            len(self._schemas),
            len(self._channels),
            0,  # attachments
            1,  # metadata
            len(self._chunk_indexes),
            self._first if self._chunk_indexes else 0,
            self._last,
            len(counts),
        )
        groups = {
            SCHEMA: b''.join(self._schemas.values()),
            CHANNEL: b''.join(self._channels),
            CHUNK_INDEX: b''.join(self._chunk_indexes),
            METADATA_INDEX: record(METADATA_INDEX, place),
            STATISTICS: record(STATISTICS, statistics + counts),
        }
        start = self._file.tell()
        summary, offsets = b'', b''
        for opcode, group in groups.items():
            if group:
                content = struct.pack('<BQQ', opcode, start + len(summary), len(group))
                offsets += record(SUMMARY_OFFSET, content)
                summary += group
        footer = struct.pack('<BQQQ', FOOTER, 20, start, start + len(summary))
        summary += offsets + footer
        self._file.write(summary + struct.pack('<I', crc32(summary)) + MAGIC)
        self._file.close()

    def abort(self) -> None:
        """Close the file as it is, after an error."""
        self._file.close()
