# SPDX-License-Identifier: Apache-2.0
"""
Storage files of mcap bags: written as rosbag2 reads them, and read with their publish times.

The mcap package writes. rosbags' own files are refused by rosbag2's C++ reader ('cannot read MCAP
in time order with no message indexes'): it closes chunks that hold no message. rosbags reads, but
gives no publish times; so messages are taken out of the chunks that it lists.
"""

from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from itertools import zip_longest
from operator import itemgetter
from pathlib import Path
import struct
from typing import Any, NamedTuple
from zlib import crc32

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import CompressionType, MCAP0_MAGIC, Writer
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2.storage_mcap import McapReader

CHUNK_SIZE = 1 << 20
"""Bytes of messages after which a chunk is closed."""
RECORD = struct.Struct('<BQ')
"""Opcode and length, before the content of each record."""
MESSAGE = struct.Struct('<HIQQ')
"""Channel, sequence, log time and publish time, before a message in CDR."""
FOOTER = struct.Struct('<BQQQI8x')
"""Opcode, length, begin of the summary and of its offsets, CRC; behind it the magic number."""
Row = tuple[int, int, int, bytes]
"""Log time and publish time (ns), channel, and message in CDR."""


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


class McapFile:
    """
    An mcap file that is written, with the methods that rosbags' `Writer` calls.

    The mcap package's `add_message` takes 4 microseconds, and a replay writes five messages for
    each sample. So the messages of a chunk are joined here, and then given to it all at once.

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
        self._writer = Writer(self._file, compression=CompressionType.NONE)
        self._writer.start('ros2', 'fhaosmo_ros')
        self._schemas: dict[str, int] = {}
        self._data = bytearray()  # message records of the chunk that is open
        self._rows: list[tuple[int, int, int]] = []  # their channels, log times and places

    def add_msgtype(self, connection: Connection) -> None:
        """Write the definition of a type."""
        is_msg = connection.msgdef.format == MessageDefinitionFormat.MSG
        self._schemas[connection.msgtype] = self._writer.register_schema(
            connection.msgtype,
            'ros2msg' if is_msg else 'ros2idl',
            connection.msgdef.data.encode(),
        )

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Write a topic with its QoS and the hash of its type."""
        self._writer.register_channel(
            connection.topic,
            'cdr',
            self._schemas[connection.msgtype],
            {
                'offered_qos_profiles': offered_qos_profiles,
                'topic_type_hash': connection.digest,
            },
        )

    def write(self, connection: Connection, stamp: int, data: bytes, published: int) -> None:
        """Append one message in CDR."""
        self._rows.append((connection.id, stamp, len(self._data)))
        self._data += RECORD.pack(Opcode.MESSAGE, MESSAGE.size + len(data))
        self._data += MESSAGE.pack(connection.id, 0, stamp, published)
        self._data += data
        if len(self._data) > CHUNK_SIZE:
            self._close_chunk()

    def write_columns(
        self, times: NDArray[np.int64], columns: Sequence[tuple[Connection, NDArray[np.uint8]]]
    ) -> None:
        """Append a message of each connection at each time; messages are (K, size) bytes."""
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
        """Hand all messages so far to the operating system."""
        self._close_chunk()
        self._writer.flush()

    def totals(self) -> tuple[dict[int, int], int, int]:
        """Return the number of messages of each channel, and the first and the last log time."""
        self._close_chunk()
        s = self._writer._Writer__statistics
        return dict(s.channel_message_counts), s.message_start_time, s.message_end_time

    def close(self, _: int, metadata: str) -> None:
        """Write the bag's metadata, the summary and the footer."""
        self._writer.add_metadata('rosbag2', {'serialized_metadata': metadata})
        self._writer.finish()
        self._file.close()

    def abort(self) -> None:
        """Close the file as it is, after an error."""
        self._file.close()


def check_summary(path: Path) -> None:
    """
    Compare the summary of an mcap file, which holds its topics and its index, with its CRC.

    Raises
    ------
    ValueError
        They differ.

    """
    with path.open('rb') as file:
        size = file.seek(0, 2)
        if size < FOOTER.size:
            return  # rosbags says what is missing
        file.seek(size - FOOTER.size)
        _, _, start, _, crc = FOOTER.unpack(file.read())
        if crc and start < size:
            file.seek(start or size - FOOTER.size)
            if crc32(file.read()[:-12]) != crc:
                raise ValueError('the summary does not agree with its CRC')


def is_cut(path: Path) -> bool:
    """Return True for an mcap file without its end: its writer was killed, or it was cut."""
    with path.open('rb') as file:
        begin = file.read(len(MCAP0_MAGIC))
        file.seek(max(0, file.seek(0, 2) - len(MCAP0_MAGIC)))
        return begin == MCAP0_MAGIC and file.read() != MCAP0_MAGIC


def copy_whole_part(path: Path, copy: Path) -> int:
    """Copy the messages of an mcap file that was cut; return how many there are."""
    count = 0
    with path.open('rb') as source, copy.open('wb') as target:
        writer = Writer(target, compression=CompressionType.NONE)
        writer.start('ros2', 'fhaosmo_ros')
        channels: dict[int, int] = {}
        held = None  # the last message may be cut
        found = NonSeekingReader(source, validate_crcs=True).iter_messages(log_time_order=False)
        with suppress(Exception):  # struct.error, those of compressors, ...
            for schema, channel, message in found:
                if held:
                    writer.add_message(*held)
                    count += 1
                if channel.id not in channels:
                    kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, kind, channel.metadata
                    )
                held = (
                    channels[channel.id], message.log_time, message.data, message.publish_time
                )  # fmt: skip
        writer.finish()
    return count


class Reading:
    """
    The messages of some channels of an open mcap file, by their log times.

    One chunk is read after the other; of a file without an index, all messages are kept in memory.

    Attributes
    ----------
    unchecked : bool
        True if something was read that has no CRC.

    """

    def __init__(self, storage: McapReader, channels: Collection[int]) -> None:
        self._storage, self._channels = storage, channels
        self.unchecked = not storage.chunks

    def __iter__(self) -> Iterator[Row]:
        if not self._storage.chunks:
            yield from self._unindexed()
            return
        # Without message indexes it is not known which channels a chunk holds.
        chunks = [
            (c.message_start_time, c.chunk_start_offset)
            for c in self._storage.chunks
            if not c.channel_count or any(map(c.channel_count.get, self._channels))
        ]
        chunks.sort()
        rows: list[Row] = []
        for (_, offset), following in zip_longest(chunks, chunks[1:]):
            rows += self._chunk(offset)
            rows.sort(key=itemgetter(0))
            # Chunks may overlap: what lies behind the next one's begin has to wait.
            ready = bisect_left(rows, following[0], key=itemgetter(0)) if following else len(rows)
            yield from rows[:ready]
            del rows[:ready]

    def _chunk(self, offset: int) -> Iterator[Row]:
        assert self._storage.bio
        self._storage.bio.seek(offset + RECORD.size)
        chunk = Chunk.read(ReadDataStream(self._storage.bio))
        self.unchecked |= not chunk.uncompressed_crc
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data, at = stream.read(size), 0
        while at < size:
            opcode, length = RECORD.unpack_from(data, at)
            at += RECORD.size
            if at + length > size:
                raise ValueError('a record goes beyond the end of its chunk')
            if opcode == Opcode.MESSAGE:
                channel, _, logged, published = MESSAGE.unpack_from(data, at)
                if channel in self._channels:
                    yield logged, published, channel, data[at + MESSAGE.size : at + length]
            at += length

    def _unindexed(self) -> Iterator[Row]:
        with self._storage.path.open('rb') as file:
            for _, channel, message in NonSeekingReader(file, validate_crcs=True).iter_messages():
                if channel.id in self._channels:
                    yield message.log_time, message.publish_time, channel.id, message.data
