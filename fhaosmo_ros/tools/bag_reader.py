# SPDX-License-Identifier: Apache-2.0
"""Reading bags as a stream: all storages, compressions and message types that rosbags knows."""

from collections.abc import Collection, Iterator
from itertools import islice
from operator import itemgetter
from pathlib import Path
import struct
from types import TracebackType
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import suggestion
from fhaosmo_ros.tools import chunks
from fhaosmo_ros.tools.bags import TYPES
from fhaosmo_ros.tools.cdr import numbers
from fhaosmo_ros.tools.fields import Field, find_field
import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import ChunkInfo, decompress, McapReader

try:
    from compression import zstd
except ImportError:  # before Python 3.14
    from backports import zstd

BLOCK = 16_384
"""Samples a block where the bag has no chunks of its own."""


class Block(NamedTuple):
    """
    Samples of one field in the order of the bag.

    Attributes
    ----------
    times : (K,) array of int
        Stamps that the bag keeps with the messages, in nanoseconds.
    stamps : (K,) array of int
        Stamps in the messages' headers, or `times` where they have none.
    values : (K,) or (K, width) array

    """

    times: NDArray[np.int64]
    stamps: NDArray[np.int64]
    values: NDArray[np.float64]


class BagReader:
    """
    An open bag: a folder with metadata.yaml, or one storage file of it.

    Raises
    ------
    ConfigurationError
        Not a bag, or a bag that can't be read; one line.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _expect_bag(path)

    def __enter__(self) -> 'BagReader':
        try:
            self._reader = AnyReader([self.path], default_typestore=TYPES)
            self._reader.open()
        except Exception as error:  # rosbags also lets IndexError, struct.error, ... through
            raise _unreadable(self.path, error) from None
        storage = self._reader.readers[0].storage
        self._storages = list(getattr(storage, 'storages', [])) or [storage]
        mode = getattr(getattr(storage, 'metadata', None), 'compression_mode', None)
        self._compressed_messages = mode == 'message'
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._reader.close()

    @property
    def connections(self) -> list[Connection]:
        """Topics with their types, QoS and message counts; a topic may appear twice."""
        return list(self._reader.connections)

    @property
    def types(self) -> Any:
        """The bag's own type definitions: a rosbags typestore."""
        return self._reader.typestore

    @property
    def span(self) -> tuple[int, int]:
        """First and last stamp in nanoseconds."""
        return self._reader.start_time, self._reader.end_time - 1

    def count(self, topic: str) -> int:
        """Return how many messages a topic has."""
        return sum(c.msgcount for c in self.connections if c.topic == topic)

    def message_type(self, topic: str) -> str:
        """
        Return a topic's message type.

        Raises
        ------
        ConfigurationError
            The topic is absent (lists those present), or has no message.

        """
        for connection in self.connections:
            if connection.topic == topic:
                if not self.count(topic):
                    raise ConfigurationError(
                        f'bag {self.path}: expected messages on topic {topic!r}, got none'
                    )
                return str(connection.msgtype)
        known = sorted({c.topic for c in self.connections})
        raise ConfigurationError(
            f'bag {self.path}: expected a topic that it holds ({", ".join(known) or "none"}), '
            f'got {topic!r}{suggestion(topic, known)}'
        )

    def messages(self, topics: list[str] | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, stamp (ns) and CDR of the messages of some topics, or of all."""
        try:
            for storage in self._storages:
                # By the storage's own connections: rosbags finds no message where the QoS of
                # metadata.yaml differs from the storage's.
                chosen = [c for c in storage.connections if topics is None or c.topic in topics]
                if chosen:
                    for connection, stamp, data in storage.messages(chosen):
                        plain = zstd.decompress(data) if self._compressed_messages else data
                        yield connection.topic, stamp, plain
        except Exception as error:
            raise _unreadable(self.path, error) from None

    def few(self, topics: Collection[str]) -> list[tuple[str, int, Any]]:
        """Return topic, stamp (ns) and message of topics that have few of them, by stamp."""
        types = {c.topic: str(c.msgtype) for c in self.connections if c.topic in topics}
        if self.has_chunks:  # most chunks hold none of them: rosbags would look at every message
            found = [
                (names[channel], time, data[start + chunks.DATA_AT : end].tobytes())
                for names, data, r in self._chunks_of(list(types))
                for time, channel, start, end in zip(*(x.tolist() for x in r), strict=True)
            ]
        else:
            found = list(self.messages(list(types)))
        found.sort(key=itemgetter(1))
        try:
            return [
                (topic, time, self._reader.deserialize(data, types[topic]))
                for topic, time, data in found
            ]
        except Exception as error:
            raise _unreadable(self.path, error) from None

    def first(self, topic: str) -> Any:
        """Return the first message of a topic that has one."""
        _, _, data = next(self.messages([topic]))
        return self._reader.deserialize(data, self.message_type(topic))

    def _chunks_of(self, topics: list[str]) -> Iterator[tuple[dict[int, str], Any, Any]]:
        for storage, _, data, records in self.chunk_records(topics):
            yield {c.id: c.topic for c in storage.connections}, data, records

    def field(self, topic: str, text: str | None) -> Field:
        """Find a numeric field of a topic; see `find_field`."""
        return find_field(self.types.fielddefs, self.message_type(topic), text)

    def blocks(
        self, topic: str, field: Field, use_header: bool = False, width: int = 1
    ) -> Iterator[Block]:
        """
        Yield a field's samples in order, in blocks; memory does not grow with the bag.

        With `width`, so many neighbours in a list, from the field on.
        """
        read = self._by_chunk if self.has_chunks else self._by_message
        yield from read(topic, field, use_header, width)

    @property
    def has_chunks(self) -> bool:
        """True if the bag is made of mcap chunks that can be taken as a whole."""
        return not self._compressed_messages and all(
            isinstance(s, McapReader) and s.chunks for s in self._storages
        )

    def chunk_records(
        self, topics: list[str] | None = None
    ) -> Iterator[tuple[Any, int, NDArray[np.uint8], chunks.Records]]:
        """Yield the storage, the next chunk's first stamp, a chunk's bytes and its messages."""
        for storage in self._storages:
            ids = [c.id for c in storage.connections if topics is None or c.topic in topics]
            found = [c for c in storage.chunks if any(c.channel_count.get(i) for i in ids)]
            found.sort(key=lambda c: (c.message_start_time, c.chunk_start_offset))
            nexts = [*(c.message_start_time for c in found[1:]), 2**63 - 1]
            for chunk, following in zip(found, nexts, strict=True):
                try:
                    data = _load(storage, chunk)
                    records = chunks.scan(data, ids)
                except Exception as error:
                    raise _unreadable(self.path, error) from None
                yield storage, following, data, records

    def index_chunks(self, offsets: list[int]) -> None:
        """Take the chunks at these places of an mcap file that has lost its index."""
        storage = self._storages[0]
        channels = {c.id: 1 for c in storage.connections}
        for offset in offsets:
            storage.bio.seek(offset)
            head = storage.bio.read(9 + 32)
            _, size, first, last, plain, _, letters = struct.unpack('<BQQQQII', head)
            compression = storage.bio.read(letters).decode()
            packed = int.from_bytes(storage.bio.read(8), 'little')
            info = ChunkInfo(
                first, last, offset, 9 + size, {}, 0, compression, packed, plain, channels
            )
            storage.chunks.append(info)

    def _by_chunk(self, topic: str, field: Field, use_header: bool, width: int) -> Iterator[Block]:
        rest = None
        for _, following, data, records in self.chunk_records([topic]):
            at = records.starts + chunks.DATA_AT
            block = self._block(records.times, data, at, records.ends, field, use_header, width)
            if rest is not None:
                block = Block(*(np.concatenate(pair) for pair in zip(rest, block, strict=True)))
            order = np.argsort(block.times, kind='stable')
            ready = int(np.searchsorted(block.times[order], following))
            yield Block(*(part[order[:ready]] for part in block))
            rest = Block(*(part[order[ready:]] for part in block))
        if rest is not None and len(rest.times):
            yield rest

    def _by_message(
        self, topic: str, field: Field, use_header: bool, width: int
    ) -> Iterator[Block]:
        found = self.messages([topic])
        while rows := list(islice(found, BLOCK)):
            _, times, texts = zip(*rows, strict=True)
            data = np.frombuffer(b''.join(texts), dtype=np.uint8)
            ends = np.cumsum([len(text) for text in texts])
            starts = np.concatenate([[0], ends[:-1]])
            times = np.array(times, np.int64)
            yield self._block(times, data, starts, ends, field, use_header, width)

    def _block(
        self, times: NDArray[np.int64], data: NDArray[np.uint8], starts: NDArray[np.int64],
        ends: NDArray[np.int64], field: Field, use_header: bool, width: int,
    ) -> Block:  # fmt: skip
        try:
            values, stamps = numbers(field, data, starts, ends, width)
        except Exception as error:
            raise _unreadable(self.path, error) from None
        return Block(times, stamps if use_header else times, values)


def _load(storage: Any, chunk: Any) -> NDArray[np.uint8]:
    """Return a chunk's bytes, decompressed and checked."""
    file = storage.bio
    file.seek(chunk.chunk_start_offset + 9 + 24)
    crc = int.from_bytes(file.read(4), 'little')
    file.seek(chunk.chunk_start_offset + 9 + 40 + len(chunk.compression))
    packed = file.read(chunk.compressed_size)
    plain = decompress(packed, chunk.compression, chunk.uncompressed_size, crc)
    return np.frombuffer(plain, dtype=np.uint8)


def _expect_bag(path: Path) -> None:
    allowed = 'expected a bag (a folder with metadata.yaml, or its .mcap or .db3 file)'
    if not path.exists():
        raise ConfigurationError(f'bag {path}: {allowed}, got a path that does not exist')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        files = sorted(p.name for p in path.iterdir() if p.suffix in ('.mcap', '.db3'))
        hint = f' but {files[0]}: name that file, or run record --repair' if files else ''
        raise ConfigurationError(f'bag {path}: {allowed}, got a folder without it{hint}')
    if path.is_file() and path.suffix not in ('.mcap', '.db3'):
        raise ConfigurationError(f'bag {path}: {allowed}, got a file that is neither')


def _unreadable(path: Path, error: Exception) -> ConfigurationError:
    if isinstance(error, ConfigurationError):
        return error
    text = ' '.join(str(error).split()) or type(error).__name__
    hint = ''
    if path.suffix == '.mcap' or (path.is_dir() and list(path.glob('*.mcap'))):
        hint = ' (if it was cut short, record --repair saves what is whole)'
    return ConfigurationError(f'bag {path}: expected a whole bag, got: {text}{hint}')
