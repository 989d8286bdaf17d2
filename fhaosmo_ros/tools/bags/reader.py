# SPDX-License-Identifier: Apache-2.0
"""Reading bags as a stream: all storages, compressions and message types that rosbags knows."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, ExitStack
from itertools import zip_longest
from operator import itemgetter
from pathlib import Path
import struct
from typing import Any, NamedTuple
from zlib import crc32

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.messages.fields import Field, find_field, MissingElementError, Unwrapper
from fhaosmo_ros.tools.bags.types import TYPES
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import McapReader
from tqdm import tqdm
import zstandard

ZSTD = b'\x28\xb5\x2f\xfd'
"""Begin of what zstd has compressed; a message in CDR begins with a zero."""
RECORD = struct.Struct('<BQ')
"""Of mcap: opcode and length, before the content of each record."""
MESSAGE = struct.Struct('<HIQQ')
"""Of mcap: channel, sequence, log time and publish time, before a message in CDR."""
FOOTER = struct.Struct('<BQQQI8s')
"""Of mcap: opcode, length, begin of the summary and of its offsets, CRC; then the magic number."""
Row = tuple[int, int, int, bytes]
"""Log time and publish time (ns), number of the connection, and message in CDR."""


class FieldSamples(NamedTuple):
    """Samples of one field in the order of the bag."""

    times: NDArray[np.int64]  # (K,) that the bag keeps with the messages (mcap: log time), in ns
    stamps: NDArray[np.int64]  # (K,) those that were asked for, in ns
    values: NDArray[np.float64]  # (K,)

    def part(self, rows: slice | NDArray[np.bool_]) -> 'FieldSamples':
        """Return some of the samples."""
        return FieldSamples(*(column[rows] for column in self))

    def unwrapped(self, near: float | None = None) -> 'FieldSamples':
        """Return the samples of an angle with its turns counted; see `Unwrapper`."""
        return self._replace(values=np.array([*map(Unwrapper(near), self.values.tolist())]))


class BagReader:
    """
    An open bag: a folder with metadata.yaml, or one storage file of it.

    Where the file has CRCs, what is read agrees with them; and a topic that is read to its end has
    as many messages as the bag lists. Anything else is an error in one line, and so is a file that
    was cut, or whose writer was killed.

    Attributes
    ----------
    connections : list of Connection
        Of rosbags: topics with their types and message counts; a topic may appear twice.
    types : Typestore
        Of rosbags, with the bag's own definitions of types.
    unchecked : bool
        True if something was read that has no CRC, so that damage may go unnoticed.
    lacking : Counter of str
        Messages that `samples` has left out, by why they lack the field.

    Raises
    ------
    ConfigurationError
        It is not a bag, or it cannot be read.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.unchecked = False
        self.lacking: Counter[str] = Counter()
        _expect_bag(path)
        with _readable(path), ExitStack() as stack:
            for file in path.iterdir() if path.is_dir() else [path]:
                if file.suffix in ('.mcap', '.db3'):
                    _expect_whole(file)
            reader = stack.enter_context(AnyReader([path], default_typestore=TYPES))
            self.connections: list[Connection] = list(reader.connections)
            self.types = reader.typestore
            storage: Any = reader.readers[0].storage
            self._storages = storage.storages if path.is_dir() else [storage]
            stored = [c for storage in self._storages for c in storage.connections]
            for topic in {c.topic for c in self.connections}:
                there = sum(c.msgcount for c in stored if c.topic == topic)
                _expect(topic, self.count(topic), there)
            self._stack = stack.pop_all()

    def __enter__(self) -> 'BagReader':
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

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
        types = {c.topic: str(c.msgtype) for c in self.connections}
        if topic not in types:
            raise ConfigurationError(
                f'bag {self.path}: expected a topic that it holds '
                f'({", ".join(sorted(types)) or "none"}), got {topic!r}{suggestion(topic, types)}'
            )
        if not self.count(topic):
            raise ConfigurationError(
                f'bag {self.path}: expected messages on topic {topic!r}, got none'
            )
        return types[topic]

    def messages(
        self, topics: Collection[str] | None = None
    ) -> Iterator[tuple[str, int, bytes, int]]:
        """
        Yield topic, stamp (ns), CDR and publish time of the messages of some topics, or of all.

        The publish time is 0 where it is not known, which only mcap has.
        """
        with _readable(self.path):
            for storage in self._storages:
                # By the storage's own connections: AnyReader.messages() yields nothing, and says
                # nothing, where the QoS of metadata.yaml differs from the storage file's.
                chosen = [c for c in storage.connections if topics is None or c.topic in topics]
                if not chosen:
                    continue
                names = {c.id: c.topic for c in chosen}
                counts = dict.fromkeys(names, 0)
                for time, published, channel, data in self._rows(storage, chosen):
                    counts[channel] += 1
                    if data[: len(ZSTD)] == ZSTD:  # metadata.yaml says so, but it may be lost
                        data = zstandard.decompress(data)
                    yield names[channel], time, data, published
                for c in chosen:
                    _expect(c.topic, c.msgcount, counts[c.id])

    def _rows(self, storage: Any, chosen: list[Connection]) -> Iterator[Row]:
        if not isinstance(storage, McapReader):
            self.unchecked = True
            for c, stamp, data in storage.messages(chosen):
                yield stamp, 0, c.id, data
        elif storage.chunks:
            yield from self._chunks(storage, {c.id for c in chosen})
        else:  # all are kept in memory, to put them in order
            self.unchecked = True
            with storage.path.open('rb') as file:
                topics = [c.topic for c in chosen]
                found = NonSeekingReader(file, validate_crcs=True).iter_messages(topics)
                for _, channel, message in found:
                    yield message.log_time, message.publish_time, channel.id, message.data

    def _chunks(self, storage: McapReader, channels: Collection[int]) -> Iterator[Row]:
        """Yield messages by log time, with the publish time that rosbags does not give."""
        # Without message indexes it is not known which channels a chunk holds.
        chunks = sorted(
            (c.message_start_time, c.chunk_start_offset)
            for c in storage.chunks
            if not c.channel_count or any(map(c.channel_count.get, channels))
        )
        rows: list[Row] = []
        for (_, offset), following in zip_longest(chunks, chunks[1:]):
            rows += self._chunk(storage, offset, channels)
            rows.sort(key=itemgetter(0))
            # Chunks may overlap: what lies behind the next one's begin has to wait.
            ready = bisect_left(rows, following[0], key=itemgetter(0)) if following else len(rows)
            yield from rows[:ready]
            del rows[:ready]

    def _chunk(self, storage: McapReader, at: int, channels: Collection[int]) -> Iterator[Row]:
        assert storage.bio
        storage.bio.seek(at + RECORD.size)
        chunk = Chunk.read(ReadDataStream(storage.bio))
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
                if channel in channels:
                    yield logged, published, channel, data[at + MESSAGE.size : at + length]
            at += length

    def objects(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any, int]]:
        """Yield topic, stamp (ns), message and publish time of the messages of some topics."""
        types = {c.topic: str(c.msgtype) for c in self.connections}
        read = self.types.deserialize_cdr
        with _readable(self.path):
            for topic, time, data, published in self.messages(topics):
                yield topic, time, read(data, types[topic]), published

    def read_all(self, topics: Collection[str]) -> list[tuple[str, int, Any]]:
        """Return topic, stamp (ns) and message, by stamp, of topics that have few messages."""
        return sorted((row[:3] for row in self.objects(topics)), key=itemgetter(1))

    def field(self, topic: str, text: str | None, name: str = '') -> Field:
        """Find a numeric field of a topic; see `find_field`."""
        kind = self.message_type(topic)
        if kind not in self.types.fielddefs:
            raise ConfigurationError(f'bag {self.path}: expected a definition of {kind}, got none')
        return find_field(self.types.fielddefs, kind, text, name)

    def samples(self, topic: str, field: Field, stamp: str = 'bag') -> FieldSamples:
        """
        Return the samples of a field; a terminal shows how far it is.

        Messages whose lists are too short or lack the name are left out, as by the node.

        Parameters
        ----------
        topic : str
        field : Field
        stamp : {'auto', 'header', 'source', 'bag'}
            'header': of the messages. 'source': the publish time, which only mcap has; `ros2 bag
            record` writes the publisher's source stamp there. 'bag': of the bag (mcap: log time),
            for `ros2 bag record` the time of reception. 'auto': the first of these that there is.

        Raises
        ------
        ConfigurationError
            The messages have no header, or the bag no publish times.

        """
        if stamp == 'header' and not field.header:
            raise ConfigurationError(
                f'input_stamp header: expected messages with a header on {topic}, '
                f'got {self.message_type(topic)}'
            )
        if stamp == 'source' and not all(isinstance(s, McapReader) for s in self._storages):
            raise ConfigurationError(
                f'input_stamp source: expected an mcap bag, got {self.path} without publish times'
            )
        if stamp == 'auto':
            stamp = 'header' if field.header else 'source'
        kinds = [('time', np.int64), ('stamp', np.int64), ('value', np.float64)]
        found, count = self._samples(topic, field, stamp), self.count(topic)
        bar = tqdm(found, topic, count, leave=False, unit='', unit_scale=True, disable=None)
        rows = np.fromiter(bar, dtype=kinds)
        return FieldSamples(*(np.ascontiguousarray(rows[name]) for name, _ in kinds))

    def _samples(self, topic: str, field: Field, stamp: str) -> Iterator[tuple[int, int, float]]:
        for _, time, message, published in self.objects([topic]):
            try:
                value = field.value(message)
            except MissingElementError as error:
                self.lacking[str(error)] += 1
                continue
            if stamp == 'header':
                yield time, field.stamp(message), value
            else:
                yield time, (published if stamp == 'source' else 0) or time, value


def _expect(topic: str, listed: int, there: int) -> None:
    """Compare the messages that are there with those that metadata or index list."""
    if there != listed:
        raise ValueError(f'{there} messages on {topic} where {listed} are listed')


def _expect_bag(path: Path) -> None:
    if path.is_file():
        if path.suffix in ('.mcap', '.db3'):
            return
        found = 'a file that is none'
        if path.suffix == '.bag':
            found = f'one of ROS 1: rosbags-convert --src {path} --dst NEW makes one of ROS 2'
    elif not path.exists():
        found = 'a path that does not exist'
    elif (path / 'metadata.yaml').exists():
        return
    else:
        files = sorted(p.name for p in path.iterdir() if p.suffix in ('.mcap', '.db3'))
        found = 'a folder without it'
        found += f' but {files[0]}: name that file, or run ros2 bag reindex' if files else ''
    raise ConfigurationError(
        f'bag {path}: expected a bag (a folder with metadata.yaml, or its .mcap or .db3), '
        f'got {found}'
    )


def _expect_whole(path: Path) -> None:
    """Refuse a storage file that was cut, or whose summary does not agree with its CRC."""
    if any(Path(f'{path}{end}').exists() for end in ('-journal', '-wal')):
        raise ValueError(
            f'a file whose writer was killed: `sqlite3 {path} .tables` takes back what is half'
        )
    if path.suffix == '.mcap':
        with path.open('rb') as file:
            place = file.seek(-FOOTER.size, 2)
            _, _, start, _, crc, magic = FOOTER.unpack(file.read())
            if magic != MCAP0_MAGIC:
                raise ValueError('a file that was cut, or whose writer was killed')
            if crc and start < place:
                file.seek(start or place)
                if crc32(file.read()[:-12]) != crc:
                    raise ValueError('the summary does not agree with its CRC')


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Say in one line what is wrong with a bag, whatever rosbags, mcap or sqlite3 raise."""
    try:
        yield
    except ConfigurationError:
        raise
    except Exception as error:
        text = ' '.join(str(error).split()) or type(error).__name__
        raise ConfigurationError(
            f'bag {path}: expected a whole bag, got: {text} (`mcap recover`, or .recover of '
            'sqlite3, saves what is whole)'
        ) from None
