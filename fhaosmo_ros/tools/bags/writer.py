# SPDX-License-Identifier: Apache-2.0
"""
Bags written as Jazzy's rosbag2 writes them, in mcap.

The mcap package writes: rosbags' own files are refused by rosbag2's C++ reader ('cannot read MCAP
in time order with no message indexes'), as it closes chunks that hold no message. `NAME_0` is how
rosbag2 names a storage file, so that `ros2 bag reindex` finds it.
"""

from collections.abc import Sequence
from copy import deepcopy
import os
from pathlib import Path
from struct import Struct
from textwrap import indent
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.files import DUMPER
from fhaosmo_ros.tools.bags.reader import BagReader, RECORD
from fhaosmo_ros.tools.bags.types import learn, OFFERED_QOS, TYPES
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

CHUNK_SIZE = 1 << 20
"""Bytes of messages after which a chunk of mcap is closed."""
HEAD, TIMES = Struct('<BQHIQQ'), slice(15, 31)
"""
What stands in front of a message in CDR: the head of a record, and that of a message, which ends
with log time and publish time.
"""


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


class BagWriter:
    """
    Writes serialised messages to a new folder in the format of Jazzy's rosbag2.

    The mcap package's `add_message` takes 4 microseconds, and a replay writes five messages for
    each sample. So the messages of a chunk are joined here, and then given to it all at once.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._topics: list[dict[str, Any]] = []  # as metadata.yaml describes them
        self._data = bytearray()  # message records of the chunk that is open
        self._rows: list[tuple[int, int, int]] = []  # their channels, log times and places

    def __enter__(self) -> 'BagWriter':
        self._path.mkdir(parents=True)
        self._file = (self._path / f'{self._path.name}_0.mcap').open('xb')
        self._writer = Writer(self._file, compression=CompressionType.NONE)
        self._statistics = self._writer._Writer__statistics
        self._writer.start('ros2', 'fhaosmo_ros')
        return self

    def add(
        self,
        topic: str,
        message_type: str,
        qos: Sequence[dict[str, Any]] = (OFFERED_QOS,),
        types: Any = TYPES,
    ) -> bool:
        """Add a topic if the bag lacks it; return False if its type has no definition here."""
        known = message_type in types.fielddefs or (types is TYPES and learn(message_type))
        if topic in self._channels:
            return known
        if not known:
            # A type that is not installed, or an old bag without definitions. Readers compare
            # the hash with the definition, so both are those of a message without fields.
            types = get_typestore(Stores.EMPTY)
            types.register(get_types_from_msg('', message_type))
        digest = types.hash_rihs01(message_type)
        if message_type not in self._schemas:
            text, _ = types.generate_msgdef(message_type, ros_version=2)
            self._schemas[message_type] = self._writer.register_schema(
                message_type, 'ros2msg', text.encode()
            )
        offered = yaml.dump(list(qos), Dumper=DUMPER)
        metadata = {'offered_qos_profiles': offered, 'topic_type_hash': digest}
        self._channels[topic] = self._writer.register_channel(
            topic, 'cdr', self._schemas[message_type], metadata
        )
        self._topics.append({
            'name': topic, 'type': message_type, 'serialization_format': 'cdr',
            'offered_qos_profiles': deepcopy(list(qos)),  # YAML refers to what it has
            'type_description_hash': digest,
        })  # fmt: skip
        return known

    def write(self, topic: str, stamp: int, data: bytes, published: int | None = None) -> None:
        """Append a message in CDR, with stamp and publish time (by default the stamp) in ns."""
        channel, sent = self._channels[topic], stamp if published is None else published
        size = HEAD.size - RECORD.size + len(data)
        self._rows.append((channel, stamp, len(self._data)))
        self._data += HEAD.pack(Opcode.MESSAGE, size, channel, 0, stamp, sent) + data
        if len(self._data) > CHUNK_SIZE:
            self.flush()

    def write_column(
        self, topic: str, times: NDArray[np.int64], message: bytes, numbers: NDArray[Any]
    ) -> None:
        """
        Append a message at each of K times (ns), all at once.

        `message`, in CDR, ends with numbers; `numbers`, of the same type, are what stands there at
        each time: an array of (K,) or (K, m).
        """
        self.flush()
        channel, size = self._channels[topic], HEAD.size - RECORD.size + len(message)
        record = HEAD.pack(Opcode.MESSAGE, size, channel, 0, 0, 0) + message
        records = np.tile(np.frombuffer(record, np.uint8), (len(times), 1))
        records[:, TIMES] = np.column_stack([times, times]).view(np.uint8)
        its_own = np.ascontiguousarray(numbers).view(np.uint8).reshape(len(times), -1)
        records[:, -its_own.shape[1] :] = its_own
        places = len(record) * np.arange(len(times))
        rows = np.column_stack([np.full(len(times), channel), times, places])
        self._write_chunk(records.tobytes(), rows)

    def _write_chunk(self, data: bytes, rows: NDArray[np.int64]) -> None:
        """Write message records as a chunk: what `Writer.add_message` does for each of them."""
        chunk, statistics = self._writer._Writer__chunk_builder, self._statistics
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

    def copy(self, reader: BagReader) -> None:
        """Copy every topic as it is."""
        for c in reader.connections:
            qos = dump_qos_v9(c.ext.offered_qos_profiles)
            self.add(c.topic, c.msgtype, qos, reader.types)
        for topic, stamp, data, published in reader.messages():
            self.write(topic, stamp, data, published)

    def flush(self) -> None:
        """Hand what has been written to the operating system: a later kill cannot take it back."""
        if self._rows:
            data, rows = bytes(self._data), np.array(self._rows, dtype=np.int64)
            self._data, self._rows = bytearray(), []
            self._write_chunk(data, rows)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._file:
            if kind:  # what has been flushed can be read
                return
            self.flush()
            information = self._information()
            text = yaml.dump(information, Dumper=DUMPER, sort_keys=False)
            self._writer.add_metadata('rosbag2', {'serialized_metadata': text})
            self._writer.finish()
        text = f'rosbag2_bagfile_information:\n{indent(text, "  ")}'
        part = self._path / 'metadata.part'
        part.write_text(text, encoding='utf-8')
        part.replace(self._path / 'metadata.yaml')

    def _information(self) -> dict[str, Any]:
        """Return what metadata.yaml says of the bag."""
        s, name = self._statistics, Path(self._file.name).name
        counts = s.channel_message_counts
        span = {
            'starting_time': {'nanoseconds_since_epoch': s.message_start_time},
            'duration': {'nanoseconds': s.message_end_time - s.message_start_time},
            'message_count': s.message_count,
        }
        return {
            'version': 9, 'storage_identifier': 'mcap', **span,
            'topics_with_message_count': [
                {'topic_metadata': topic, 'message_count': counts.get(channel, 0)}
                for topic, channel in zip(self._topics, self._channels.values(), strict=True)
            ],
            'compression_format': '', 'compression_mode': '', 'relative_file_paths': [name],
            'files': [{'path': name, **deepcopy(span)}], 'custom_data': None,
            'ros_distro': os.environ.get('ROS_DISTRO') or 'jazzy',
        }  # fmt: skip
