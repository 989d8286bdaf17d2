# SPDX-License-Identifier: Apache-2.0
"""Our mcap bags fulfil what rosbag2's C++ reader (mcap 1.3.0, reader.inl) asks for, by name."""

import re
import struct
from zlib import crc32

import bag_files as files
from fhaosmo_ros.tools.bags.repair import repair
from fhaosmo_ros.tools.bags.types import LATCHED_QOS
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
from mcap.reader import make_reader, NonSeekingReader
import pytest
import yaml

KIND = 'std_msgs/msg/Float64'
MAGIC = b'\x89MCAP0\r\n'


def split(data, begin, end):
    """Yield the place, the opcode and the content of the records of a part of a file."""
    while begin < end:
        opcode, length = struct.unpack_from('<BQ', data, begin)
        assert begin + 9 + length <= end, 'a record goes beyond its section'
        yield begin, opcode, data[begin + 9 : begin + 9 + length]
        begin += 9 + length


def texts(content, count):
    """Return so many strings, and what follows them."""
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from('<I', content)
        found.append(content[4 : 4 + length].decode())
        content = content[4 + length :]
    return found, content


class File:
    """An mcap file, parsed by nothing but struct."""

    def __init__(self, path):
        self.name, self.data = path.name, path.read_bytes()
        self.end = len(self.data) - 37
        self.start, self.offsets, self.crc = struct.unpack_from('<QQI', self.data, self.end + 9)
        self.front = list(split(self.data, 8, self.start))
        self.summary = list(split(self.data, self.start, self.offsets))
        self.chunks = [
            c for place, op, content in self.front if op == 6 for c in [(place, content)]
        ]
        self.indexes = [content for _, op, content in self.summary if op == 8]

    def of(self, part, opcode):
        return [content for _, op, content in part if op == opcode]

    def messages(self, content):
        """Return the place, channel and log time of the messages of a chunk."""
        (letters,) = struct.unpack_from('<I', content, 28)
        assert letters == 0
        records = content[40:]
        found = list(split(records, 0, len(records)))
        assert {op for _, op, _ in found} == {5}, 'a chunk holds messages only'
        return [(place, *struct.unpack_from('<HIQ', c)[::2]) for place, _, c in found]


def magic(f):
    assert f.data[:8] == f.data[-8:] == MAGIC


def header_profile(f):
    assert f.front[0][1] == 1
    assert texts(f.front[0][2], 2)[0][0] == 'ros2'


def footer(f):
    assert struct.unpack_from('<BQ', f.data, f.end) == (2, 20)
    assert 8 < f.start < f.offsets < f.end


def data_end(f):
    assert [op for _, op, _ in f.front].index(15) == len(f.front) - 1


def summary_crc(f):
    assert f.crc == crc32(f.data[f.start : -12]) != 0


def summary_offsets(f):
    groups = {}
    for place, opcode, content in f.summary:
        begin, size = groups.get(opcode, (place, 0))
        assert place == begin + size, 'records of a kind stand together'
        groups[opcode] = begin, size + 9 + len(content)
    found = [struct.unpack('<BQQ', c) for _, op, c in split(f.data, f.offsets, f.end) if op == 14]
    assert {op: (begin, size) for op, begin, size in found} == groups


def schemas_and_channels_come_before_their_messages(f):
    known = {0}
    for _, opcode, content in f.front:
        if opcode == 3:
            known.add(('schema', struct.unpack_from('<H', content)[0]))
        if opcode == 4:
            channel, schema = struct.unpack_from('<HH', content)
            assert schema > 0
            assert ('schema', schema) in known
            known.add(channel)
        if opcode == 6:
            assert {channel for _, channel, _ in f.messages(content)} <= known


def schemas_and_channels_are_in_the_summary(f):
    for opcode in (3, 4):
        assert f.of(f.front, opcode) == f.of(f.summary, opcode)


def channel_metadata(f):
    for content in f.of(f.summary, 4):
        (_, encoding), rest = texts(content[4:], 2)
        pairs = texts(rest[4:], 4)[0]
        assert encoding == 'cdr'
        assert pairs[::2] == ['offered_qos_profiles', 'topic_type_hash']
        assert isinstance(yaml.safe_load(pairs[1]), list)
        assert re.fullmatch('RIHS01_[0-9a-f]{64}', pairs[3])


def every_chunk_has_messages(f):
    assert all(f.messages(content) for _, content in f.chunks)


def chunk_crcs(f):
    for _, content in f.chunks:
        assert struct.unpack_from('<I', content, 24)[0] == crc32(content[40:]) != 0


def every_chunk_index_has_message_indexes(f):
    """'cannot read MCAP in time order with no message indexes' is what it says otherwise."""
    assert len(f.indexes) == len(f.chunks)
    for index, (place, content) in zip(f.indexes, f.chunks, strict=True):
        first, last, at, length, size = struct.unpack_from('<QQQQI', index)
        offsets = dict(struct.iter_unpack('<HQ', index[36 : 36 + size]))
        (indexed,) = struct.unpack_from('<Q', index, 36 + size)
        assert (at, length) == (place, 9 + len(content))
        assert indexed > 0
        found = {}
        following = list(split(f.data, at + length, at + length + indexed))
        for begin, opcode, entries in following:
            channel, extent = struct.unpack_from('<HI', entries)
            assert opcode == 7
            assert offsets[channel] == begin
            assert extent == len(entries) - 6
            found[channel] = list(struct.iter_unpack('<QQ', entries[6:]))
        assert found.keys() == offsets.keys()
        messages = f.messages(content)
        listed = sorted((at, c, time) for c, rows in found.items() for time, at in rows)
        assert listed == messages, 'the entries are complete'
        times = [time for _, _, time in messages]
        assert (min(times), max(times)) == (first, last)
        assert (first, last) == struct.unpack_from('<QQ', content)


def chunk_indexes_in_the_order_of_the_file(f):
    places = [struct.unpack_from('<Q', index, 16)[0] for index in f.indexes]
    assert places == sorted(places)


def statistics(f):
    (content,) = f.of(f.summary, 11)
    total, schemas, channels, attachments, metadata, chunks, first, last, size = (
        struct.unpack_from('<QHIIIIQQI', content)
    )
    messages = [m for _, c in f.chunks for m in f.messages(c)]
    counts = dict(struct.iter_unpack('<HQ', content[46 : 46 + size]))
    assert total == len(messages) == sum(counts.values())
    assert counts == {
        channel: sum(m[1] == channel for m in messages)
        for channel in (struct.unpack_from('<H', c)[0] for c in f.of(f.summary, 4))
    }
    kinds = [len(f.of(f.summary, opcode)) for opcode in (3, 4, 9, 13, 8)]
    assert kinds == [schemas, channels, attachments, metadata, chunks]
    times = [m[2] for m in messages] or [0]
    assert (first, last) == (min(times), max(times))


def metadata_record(f):
    (content,) = f.of(f.summary, 13)
    begin, length = struct.unpack_from('<QQ', content)
    assert texts(content[16:], 1)[0] == ['rosbag2']
    ((_, opcode, record),) = split(f.data, begin, begin + length)
    (name, key, value), _ = (
        ([texts(record, 1)[0][0], *texts(texts(record, 1)[1][4:], 2)[0]], None)
    )  # fmt: skip
    assert (opcode, name, key) == (12, 'rosbag2', 'serialized_metadata')
    information = yaml.safe_load(value)
    (statistics,) = f.of(f.summary, 11)
    assert information['message_count'] == struct.unpack_from('<Q', statistics)[0]
    assert information['relative_file_paths'] == [f.name]
    assert [file['path'] for file in information['files']] == [f.name]


CONDITIONS = [
    magic, header_profile, footer, data_end, summary_crc, summary_offsets,
    schemas_and_channels_come_before_their_messages, schemas_and_channels_are_in_the_summary,
    channel_metadata, every_chunk_has_messages, chunk_crcs,
    every_chunk_index_has_message_indexes, chunk_indexes_in_the_order_of_the_file, statistics,
    metadata_record,
]  # fmt: skip


def number(bag, topic, count, begin=0):
    for k in range(begin, begin + count):
        bag.write(topic, 1000 + k, files.float64(k))


def recorded(path):
    """Topics appear in between, as in `record`; it flushes twice a second."""
    with BagWriter(path) as bag:
        bag.flush()
        bag.add('/y', KIND)
        bag.flush()
        number(bag, '/y', 500)
        bag.add('/late', 'sensor_msgs/msg/JointState')
        number(bag, '/y', 10, 500)
        bag.flush()
        bag.flush()
        bag.add('/z', KIND)
        number(bag, '/z', 300, 400)


def demo(path):
    """All topics are known at the begin, but the first messages come later."""
    with BagWriter(path) as bag:
        for topic in ('/y', '/u', '/z'):
            bag.add(topic, KIND)
        bag.flush()
        number(bag, '/y', 50)


def without_messages(path):
    with BagWriter(path) as bag:
        bag.add('/y', KIND)
        bag.flush()


def one_message(path):
    with BagWriter(path) as bag:
        bag.add('/y', KIND)
        bag.write('/y', 5, files.float64(1.0))


def latched_only(path):
    with BagWriter(path) as bag:
        bag.add('/y', KIND)
        bag.add('/description', 'std_msgs/msg/String', qos=[LATCHED_QOS])
        bag.flush()
        bag.write('/description', 5, files.cdr('std_msgs/msg/String', data='<robot/>'))


def many_messages(path):
    with BagWriter(path) as bag:
        bag.add('/y', KIND)
        number(bag, '/y', 100_000)


def replayed(path):
    stamps, y = files.signal(3000)
    bag = files.write(path.with_name('source'), files.floats(stamps, y))
    assert replay.main([str(bag), '-o', str(path)]) == 0


def replayed_twice(path):
    replayed(path.with_name('once'))
    assert replay.main([str(path.with_name('once')), '-o', str(path)]) == 0


def repaired(path):
    recorded(path.with_name('whole'))
    repair(path.with_name('whole'), path, 'mcap')


def repaired_after_a_cut(path):
    recorded(path.with_name('cut'))
    (file,) = path.with_name('cut').glob('*.mcap')
    file.write_bytes(file.read_bytes()[:-6000])
    repair(path.with_name('cut'), path, 'mcap')


@pytest.mark.parametrize('make', [
    recorded, demo, without_messages, one_message, latched_only, many_messages, replayed,
    replayed_twice, repaired, repaired_after_a_cut,
])  # fmt: skip
def test_conditions_of_the_cpp_reader(make, tmp_path):
    make(tmp_path / 'bag')
    file = tmp_path / 'bag' / 'bag_0.mcap'
    failed = []
    parsed = File(file)
    for condition in CONDITIONS:
        try:
            condition(parsed)
        except (AssertionError, LookupError, ValueError) as error:
            failed.append(f'{condition.__name__}: {error}')
    assert not failed, '\n'.join(failed)
    information = yaml.safe_load((file.parent / 'metadata.yaml').read_text())
    assert information['rosbag2_bagfile_information']['relative_file_paths'] == [file.name]
    with file.open('rb') as stream:  # by another reader
        reader = make_reader(stream, validate_crcs=True)
        total = reader.get_summary().statistics.message_count
        times = [message.log_time for _, _, message in reader.iter_messages()]
    assert len(times) == total
    assert times == sorted(times)
    with file.open('rb') as stream:  # and without the index, as a stream
        streamed = NonSeekingReader(stream, validate_crcs=True)
        assert sum(1 for _ in streamed.iter_messages()) == total
