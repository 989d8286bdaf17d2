# SPDX-License-Identifier: Apache-2.0
"""Reading bags as a stream: all storages, compressions and message types that rosbags knows."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Container, Iterator, Mapping
from contextlib import contextmanager, ExitStack
from io import BytesIO
from itertools import chain, islice, pairwise
from math import inf
from mmap import ACCESS_READ, mmap
from operator import itemgetter
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple
from zlib import crc32

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.messages.fields import Field, find_field, MissingElementError, Unwrapper
from fhaosmo_ros.tools.bags.types import TYPES
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream
import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import McapReader
from tqdm import tqdm
import zstandard

ZSTD = b'\x28\xb5\x2f\xfd'
"""Begin of what zstd has compressed; a message in CDR begins with a zero."""
RECORD, MESSAGE = Struct('<BQ'), Struct('<HIQQ')
"""
Of mcap, in front of each record: opcode and length; and in front of a message in CDR, behind that:
channel, sequence, log time and publish time.
"""
Row = tuple[int, int, int, bytes]
"""Log time and publish time (ns), number of the connection, and message in CDR."""


class Samples(NamedTuple):
    """Numbers of a topic's messages, in the order of the bag."""

    times: NDArray[np.int64]  # (K,) that the bag keeps with the messages (mcap: log time), in ns
    stamps: NDArray[np.int64]  # (K,) those that were asked for, in ns
    values: NDArray[Any]  # (K,) of a field or a Float64; (K, n) of lists; (K,) of a Time, in ns

    def part(self, rows: slice | NDArray[np.bool_]) -> 'Samples':
        """Return some of the samples."""
        return Samples(*(column[rows] for column in self))

    def unwrapped(self, near: float | None = None) -> 'Samples':
        """Return the samples of an angle with its turns counted; see `Unwrapper`."""
        return self._replace(values=np.array([*map(Unwrapper(near), self.values.tolist())]))


class BagReader:
    """
    An open bag: a folder with metadata.yaml, or one storage file of it.

    Where the file has CRCs, what is read agrees with them; and a topic that is read to its end has
    as many messages as the bag lists. Anything else is a ConfigurationError of one line, and so is
    a path that is no bag, and a file that was cut, or whose writer was killed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lacking: Counter[str] = Counter()  # messages that `samples` left out, by the reason
        with _readable(path), ExitStack() as stack:
            _expect_bag(path)
            reader = stack.enter_context(AnyReader([path], default_typestore=TYPES))
            # Topics, their types and message counts; a topic may appear twice.
            self.connections: list[Connection] = list(reader.connections)
            self.types = reader.typestore  # with the bag's own definitions
            storage: Any = reader.readers[0].storage
            self._storages = storage.storages if path.is_dir() else [storage]
            for storage in self._storages:
                if isinstance(storage, McapReader) and storage.bio:
                    storage.bio.seek(storage.data_end)
                    summary = storage.bio.read()
                    crc = int.from_bytes(summary[-12:-8], 'little')
                    if crc and crc32(summary[:-12]) != crc:
                        raise ValueError('the summary does not agree with its CRC')
            self._stack = stack.pop_all()

    def __enter__(self) -> 'BagReader':
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def count(self, topic: str) -> int:
        """Return how many messages a topic has."""
        return sum(c.msgcount for c in self.connections if c.topic == topic)

    def names_above(self, part: str) -> list[str]:
        """Return whose topics of this last part have messages: '/e' of '/e/state'."""
        found = {c.topic for c in self.connections if c.msgcount and c.topic.endswith(f'/{part}')}
        return sorted(topic.removesuffix(f'/{part}') for topic in found)

    def message_type(self, topic: str) -> str:
        """Return the type of a topic that has messages; raise ConfigurationError for others."""
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
        wanted = {c.topic for c in self.connections} if topics is None else set(topics)
        counts = dict.fromkeys(wanted, 0)
        with _readable(self.path):
            for storage in self._storages:
                # By the storage's own connections: AnyReader.messages() yields nothing, and says
                # nothing, where the QoS of metadata.yaml differs from the storage file's.
                chosen = {c.id: c for c in storage.connections if c.topic in wanted}
                if not chosen:  # rosbags takes that for all
                    continue
                for time, published, number, data in self._rows(storage, chosen):
                    topic = chosen[number].topic
                    counts[topic] += 1
                    if data[: len(ZSTD)] == ZSTD:  # metadata.yaml says so, but it may be lost
                        data = zstandard.decompress(data)
                    yield topic, time, data, published
            for topic, there in counts.items():
                if (listed := self.count(topic)) != there:
                    raise ValueError(f'{there} messages on {topic} where {listed} are listed')

    def _rows(self, storage: Any, chosen: Mapping[int, Connection]) -> Iterator[Row]:
        """Yield messages by log time, with the publish time of mcap, which rosbags leaves out."""
        if not isinstance(storage, McapReader):
            for c, stamp, data in storage.messages(chosen.values()):
                yield stamp, 0, c.id, data
            return
        assert storage.bio
        # Without message indexes it is not known which channels a chunk holds.
        parts = sorted(
            (c.message_start_time, c.chunk_start_offset, c.chunk_start_offset + c.chunk_length)
            for c in storage.chunks
            if not c.channel_count or not chosen.keys().isdisjoint(c.channel_count)
        )
        if not storage.chunks:  # all is kept in memory, to put it in order
            parts = [(0, storage.data_start, storage.data_end)]
        rows: list[Row] = []
        with mmap(storage.bio.fileno(), 0, access=ACCESS_READ) as file:
            for (_, begin, end), (following, *_) in pairwise([*parts, (inf, 0, 0)]):
                rows += self._messages(file, begin, end, chosen)
                rows.sort(key=itemgetter(0))
                if rows and rows[-1][0] >= 2**63:  # it would not fit into arrays
                    raise ValueError('a stamp beyond the year 2262')
                # Chunks may overlap: what lies behind the next one's begin has to wait.
                ready = bisect_left(rows, following, key=itemgetter(0))
                yield from rows[:ready]
                del rows[:ready]

    def _messages(
        self, data: bytes | mmap, at: int, end: int, chosen: Container[int]
    ) -> Iterator[Row]:
        """Yield the messages in some records of an mcap file, also those in chunks."""
        of_messages = int(Opcode.MESSAGE)  # which is quicker to compare with
        while at < end:
            opcode, length = RECORD.unpack_from(data, at)
            begin, at = at + RECORD.size, at + RECORD.size + length
            if at > end:
                raise ValueError('a record goes beyond the end of its chunk')
            if opcode == of_messages:
                channel, _, logged, published = MESSAGE.unpack_from(data, begin)
                if channel in chosen:
                    yield logged, published, channel, data[begin + MESSAGE.size : at]
            elif opcode == Opcode.CHUNK:
                chunk = Chunk.read(ReadDataStream(BytesIO(data[begin:at])))
                stream, size = get_chunk_data_stream(chunk, validate_crc=True)
                yield from self._messages(stream.read(size), 0, size, chosen)
            elif opcode == Opcode.DATA_END:
                crc = int.from_bytes(data[begin:at], 'little')
                if crc and crc32(memoryview(data)[: begin - RECORD.size]) != crc:
                    raise ValueError('the messages do not agree with their CRC')

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

    def samples(self, topic: str, field: Field | None = None, stamp: str = 'reception') -> Samples:
        """
        Return the samples of a field, or of the data of Float64, Float64MultiArray, Time (in ns).

        Messages whose lists are too short or lack the name are left out, as by the node. A
        terminal shows how far it is.

        Stamps are those of the headers ('header'), the publish time ('source'), which only mcap
        has, and where `ros2 bag record` writes the publisher's source stamp, the time in the bag
        ('reception'; mcap: log time), or the first of these that there is ('auto').
        """
        header = field.stamp if field and field.header else None
        if stamp == 'header' and not header:
            raise ConfigurationError(
                f'input_stamp header: expected messages with a header on {topic}, '
                f'got {self.message_type(topic)}'
            )
        if stamp == 'source' and not all(isinstance(s, McapReader) for s in self._storages):
            raise ConfigurationError(
                f'input_stamp source: expected an mcap bag, got {self.path} without publish times'
            )
        by_header = header if stamp in ('auto', 'header') else None
        by_source = stamp in ('auto', 'source')
        numbers = field.value if field else _all_numbers(topic)

        def samples() -> Iterator[tuple[int, int, Any]]:
            for _, time, message, published in self.objects([topic]):
                try:
                    value = numbers(message)
                except MissingElementError as error:
                    self.lacking[str(error)] += 1
                    continue
                if by_header:
                    yield time, by_header(message), value
                else:
                    yield time, (published if by_source else 0) or time, value

        count = self.count(topic)
        bar = tqdm(samples(), topic, count, leave=False, unit='', unit_scale=True, disable=None)
        with _readable(self.path):  # as of a number that does not fit into 64 bits
            rows = iter(bar)
            first = [*islice(rows, 1)]
            value = np.asarray(first[0][2] if first else 0.0)
            kinds = [('t', np.int64), ('s', np.int64), ('x', value.dtype, value.shape)]
            table = np.fromiter(chain(first, rows), kinds)
        return Samples(*(np.ascontiguousarray(table[name]) for name, *_ in kinds))


def _all_numbers(topic: str) -> Callable[[Any], Any]:
    """Return what takes all numbers of a message, of which each has as many."""
    sizes = set()

    def numbers(message: Any) -> Any:
        if hasattr(message, 'nanosec'):
            return message.sec * 1_000_000_000 + message.nanosec
        sizes.add(np.size(message.data))
        if len(sizes) > 1:
            raise ConfigurationError(f'topic {topic!r}: expected lists of one length, got several')
        return message.data

    return numbers


def _expect_bag(path: Path) -> None:
    """Raise if a path is no bag, or one that is being written, or was when its writer died."""
    is_bag = (path / 'metadata.yaml').exists() or path.suffix in ('.mcap', '.db3')
    if not (path.exists() and is_bag):
        found = 'a folder without it' if path.is_dir() else 'another file'
        raise ConfigurationError(
            f'bag {path}: expected a folder with metadata.yaml (`ros2 bag reindex` makes it), or '
            'an .mcap or .db3 file (`rosbags-convert` makes one of a bag of ROS 1), got '
            f'{found if path.exists() else "a path that does not exist"}'
        )
    for file in [path, *path.glob('*.db3')]:
        if any(Path(f'{file}{end}').exists() for end in ('-journal', '-wal')):
            raise ValueError(
                f'a file whose writer was killed: `sqlite3 {file} .tables` takes back what is half'
            )


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
            f'bag {path}: expected a whole bag, got: {text} (where a file was cut or '
            'damaged, `mcap recover`, or .recover of sqlite3, saves what is whole)'
        ) from None
