# SPDX-License-Identifier: Apache-2.0
"""
Reading bags as a stream: all storages, compressions and message types that rosbags knows.

rosbags opens the bag and knows its types, connections and chunks. Its own API hands out one Python
object a message, which takes 1.9 microseconds for a Float64; here a field of all messages of a
chunk becomes one array (mcap/chunks.py, cdr.py), which takes 0.05 microseconds a sample. sqlite3
goes message by message.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.cdr import numbers
from fhaosmo_ros.tools.bags.fields import Field, find_field
from fhaosmo_ros.tools.bags.mcap import chunks
from fhaosmo_ros.tools.bags.mcap.pieces import check_summary, find_pieces, load
from fhaosmo_ros.tools.bags.ros1 import Ros1Storage, with_header_of_ros2
from fhaosmo_ros.tools.bags.types import LATCHED_QOS, OFFERED_QOS, TYPES
import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2.storage_mcap import McapReader

BLOCK = 16_384
"""Samples in a block where the bag has no chunks of its own."""


STAMPS = ('auto', 'header', 'source', 'bag')
"""Stamps to choose from; see `BagReader.blocks`."""


class Block(NamedTuple):
    """
    Samples of one field in the order of the bag.

    Attributes
    ----------
    times : (K,) array of int
        Stamps that the bag keeps with the messages (mcap: log time), in nanoseconds.
    stamps : (K,) array of int
        The stamps that were asked for, in nanoseconds.
    values : (K,) or (K, width) array

    """

    times: NDArray[np.int64]
    stamps: NDArray[np.int64]
    values: NDArray[np.float64]


class BagReader:
    """
    An open bag: a folder with metadata.yaml, one storage file of it, or a bag of ROS 1.

    Where the file has CRCs, what is read agrees with them; and a topic that is read to its end has
    as many messages as the bag lists.

    Attributes
    ----------
    unchecked : bool
        True if something was read that has no CRC, so that damage may go unnoticed.

    Raises
    ------
    ConfigurationError
        It is not a bag, or it cannot be read.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _expect_bag(path)
        self.unchecked = False

    def __enter__(self) -> 'BagReader':
        try:
            for file in [self.path] if self.path.is_file() else self.path.glob('*.mcap'):
                if file.suffix == '.mcap':
                    check_summary(file)
            self._reader = AnyReader([self.path], default_typestore=TYPES)
            self._reader.open()
        except Exception as error:  # rosbags also lets IndexError, struct.error, ... through
            raise _unreadable(self.path, error) from None
        self._types = self._reader.typestore
        first: Any = self._reader.readers[0]
        if self._reader.is2:
            self._storages = list(getattr(first.storage, 'storages', [])) or [first.storage]
        else:
            self._types = with_header_of_ros2(self._types)
            self._storages = [Ros1Storage(first, self._types)]
        stored = [c for s in self._storages for c in s.connections]
        try:
            for topic in {c.topic for c in self.connections}:
                there = sum(c.msgcount for c in stored if c.topic == topic)
                self._expect(topic, self.count(topic), there)
        except ConfigurationError:
            self._reader.close()
            raise
        return self

    def _expect(self, topic: str, listed: int, there: int) -> None:
        """Compare the messages that are there with those that metadata or index list."""
        if there != listed:
            error = ValueError(f'{there} messages on {topic} where {listed} are listed')
            raise _unreadable(self.path, error)

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    @property
    def connections(self) -> list[Connection]:
        """Topics with their types and message counts; a topic may appear twice."""
        return list(self._reader.connections)

    def offered(self, connection: Connection) -> tuple[Sequence[Qos], str]:
        """Return the QoS of a topic of the bag, and the hash of its type, '' if not known."""
        if self._reader.is2:
            return connection.ext.offered_qos_profiles, connection.digest
        return [LATCHED_QOS if connection.ext.latching else OFFERED_QOS], ''

    @property
    def types(self) -> Any:
        """The bag's own type definitions: a rosbags typestore."""
        return self._types

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
                # By the storage's own connections: AnyReader.messages() yields nothing, and says
                # nothing, where the QoS of metadata.yaml differs from the storage file's.
                chosen = [c for c in storage.connections if topics is None or c.topic in topics]
                if not chosen:
                    continue
                self.unchecked |= not isinstance(storage, McapReader)
                counts: Counter[int] = Counter()
                for connection, stamp, data in storage.messages(chosen):
                    counts[connection.id] += 1
                    yield connection.topic, stamp, chunks.decompress_message(data)
                for c in chosen:
                    self._expect(c.topic, c.msgcount, counts[c.id])
        except Exception as error:
            raise _unreadable(self.path, error) from None

    def read_all(self, topics: Collection[str]) -> list[tuple[str, int, Any]]:
        """Return topic, stamp (ns) and message, by stamp, of topics that have few messages."""
        types = {c.topic: str(c.msgtype) for c in self.connections if c.topic in topics}
        if self.has_chunks:  # most chunks hold none of them; rosbags goes through every message
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
                (topic, time, self._types.deserialize_cdr(data, types[topic]))
                for topic, time, data in found
            ]
        except Exception as error:
            raise _unreadable(self.path, error) from None

    def first(self, topic: str) -> Any:
        """Return the first message of a topic that has one."""
        _, _, data = next(self.messages([topic]))
        return self._types.deserialize_cdr(data, self.message_type(topic))

    def _chunks_of(self, topics: list[str]) -> Iterator[tuple[dict[int, str], Any, Any]]:
        for storage, _, data, records in self.chunk_records(topics):
            yield {c.id: c.topic for c in storage.connections}, data, records

    def field(self, topic: str, text: str | None) -> Field:
        """Find a numeric field of a topic; see `find_field`."""
        return find_field(self.types.fielddefs, self.message_type(topic), text)

    def blocks(
        self, topic: str, field: Field, stamp: str = 'bag', width: int = 1
    ) -> Iterator[Block]:
        """
        Yield a field's samples in order, in blocks; memory does not grow with the bag.

        Parameters
        ----------
        topic : str
        field : Field
        stamp : {'auto', 'header', 'source', 'bag'}
            'header': of the messages. 'source': the publish time, which only mcap has; `ros2 bag
            record` writes the publisher's source stamp there. 'bag': of the bag (mcap: log time),
            for `ros2 bag record` the time of reception. 'auto': the first of these that there is.
        width : int
            Read so many neighbours in a list, from the field on.

        Raises
        ------
        ConfigurationError
            The messages have no header, or the bag no publish times.

        """
        if stamp == 'header' and not field.has_header:
            raise ConfigurationError(
                f'--stamp header: expected messages with a header on {topic}, '
                f'got {self.message_type(topic)}'
            )
        if stamp == 'source' and not self.has_chunks:
            raise ConfigurationError(
                f'--stamp source: expected an mcap bag, got {self.path} without publish times'
            )
        if stamp == 'auto':
            stamp = 'header' if field.has_header else 'source'
        read = self._by_chunk if self.has_chunks else self._by_message
        return read(topic, _Wanted(field, stamp, width))

    @property
    def has_chunks(self) -> bool:
        """Return True for an mcap bag: its messages are taken a chunk at a time."""
        return all(isinstance(s, McapReader) for s in self._storages)

    def chunk_records(
        self, topics: list[str] | None = None
    ) -> Iterator[tuple[Any, int, NDArray[np.uint8], chunks.Records]]:
        """
        Yield a chunk's storage, the first stamp of the chunk after it, its bytes and messages.

        Chunks come by their first stamp, but may overlap: what lies behind the next chunk's first
        stamp is not yet in order.
        """
        for storage in self._storages:
            chosen = [c for c in storage.connections if topics is None or c.topic in topics]
            ids = [c.id for c in chosen]
            counts: Counter[int] = Counter()
            try:
                found = [p for p in find_pieces(storage) if any(p.counts.get(i) for i in ids)]
                found.sort(key=lambda p: (p.first, p.offset))
                nexts = [*(p.first for p in found[1:]), 2**63 - 1]
                for piece, following in zip(found, nexts, strict=False):
                    data, proven = load(storage, piece)
                    self.unchecked |= not proven
                    records = chunks.scan(data, ids)
                    present = np.unique(records.channels, return_counts=True)
                    counts.update(dict(zip(*(x.tolist() for x in present), strict=True)))
                    yield storage, following, *chunks.decompress_messages(data, records)
            except Exception as error:
                raise _unreadable(self.path, error) from None
            for c in chosen:
                self._expect(c.topic, c.msgcount, counts[c.id])

    def _by_chunk(self, topic: str, wanted: '_Wanted') -> Iterator[Block]:
        rest = None  # samples that a message of the next chunk may still precede
        for _, following, data, records in self.chunk_records([topic]):
            block = self._block(data, records, wanted)
            if rest is not None:
                block = Block(*(np.concatenate(pair) for pair in zip(rest, block, strict=True)))
            order = np.argsort(block.times, kind='stable')
            ready = int(np.searchsorted(block.times[order], following))
            yield Block(*(part[order[:ready]] for part in block))
            rest = Block(*(part[order[ready:]] for part in block))
        if rest is not None and len(rest.times):
            yield rest

    def _by_message(self, topic: str, wanted: '_Wanted') -> Iterator[Block]:
        found = self.messages([topic])
        while rows := list(islice(found, BLOCK)):
            _, times, texts = zip(*rows, strict=True)
            yield self._block(*chunks.pack([0] * len(rows), times, texts), wanted)

    def _block(self, data: chunks.Bytes, records: chunks.Records, wanted: '_Wanted') -> Block:
        times, starts, ends = records.times, records.starts, records.ends
        try:
            values, stamps = numbers(
                wanted.field, data, starts + chunks.DATA_AT, ends, wanted.width
            )
        except Exception as error:
            raise _unreadable(self.path, error) from None
        if wanted.stamp == 'source':
            stamps = chunks.gather(data, starts + chunks.PUBLISHED_AT, np.dtype('<i8'))
            stamps = np.where(stamps > 0, stamps, times)  # 0: its writer did not know
        elif wanted.stamp == 'bag':
            stamps = times
        return Block(times, stamps, values)


class _Wanted(NamedTuple):
    """What to read of each message: see `BagReader.blocks`; without 'auto'."""

    field: Field
    stamp: str
    width: int


def _expect_bag(path: Path) -> None:
    allowed = 'expected a bag (a folder with metadata.yaml, its .mcap or .db3, or a ROS 1 .bag)'
    if not path.exists():
        raise ConfigurationError(f'bag {path}: {allowed}, got a path that does not exist')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        files = sorted(p.name for p in path.iterdir() if p.suffix in ('.mcap', '.db3'))
        hint = f' but {files[0]}: name that file, or run record --repair' if files else ''
        raise ConfigurationError(f'bag {path}: {allowed}, got a folder without it{hint}')
    if path.is_file() and path.suffix not in ('.mcap', '.db3', '.bag'):
        raise ConfigurationError(f'bag {path}: {allowed}, got a file that is none')


def _unreadable(path: Path, error: Exception) -> ConfigurationError:
    if isinstance(error, ConfigurationError):
        return error
    text = ' '.join(str(error).split()) or type(error).__name__
    return ConfigurationError(
        f'bag {path}: expected a whole bag, got: {text} (record --repair saves what is whole)'
    )
