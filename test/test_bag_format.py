# SPDX-License-Identifier: Apache-2.0
"""Bags have what Jazzy's rosbag2 writes and reads, as seen by readers that are not rosbags."""

import struct

import bag_files as files
from fhaosmo_ros.tools.bags.types import LATCHED_QOS, OFFERED_QOS
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader, NonSeekingReader
from mcap.records import Chunk, MessageIndex
from mcap_ros2.decoder import DecoderFactory
import pytest
import yaml

FLOAT_HASH = 'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a'
"""Of std_msgs/msg/Float64 in Jazzy."""
SEEN_QOS = LATCHED_QOS | {'history': 'unknown', 'depth': 0}
"""As the middleware tells of a publisher: it does not know history and depth."""


def test_metadata_is_as_rosbag2_writes_it(tmp_path):
    """As that of rosbags; and again in the file, where the parser of the C++ reader looks."""
    messages = [
        ('/y', files.FLOAT, 5, files.float64(1.5)), ('/late', files.FLOAT, 7, files.float64(-2.5)),
        ('/y', files.FLOAT, 9, files.float64(2.5)),
    ]  # fmt: skip
    text = (files.write(tmp_path / 'theirs', messages) / 'metadata.yaml').read_text()
    text = text.replace('theirs.mcap', 'bag_0.mcap').replace('distro: rosbags', 'distro: jazzy')
    expected = yaml.safe_load(text)
    profiles = {'/y': [OFFERED_QOS], '/late': [SEEN_QOS]}
    with BagWriter(tmp_path / 'bag') as bag:
        for topic, qos in profiles.items():
            bag.add(topic, files.FLOAT, qos)
        for topic, _, stamp, data in messages:
            bag.write(topic, stamp, data)
    for topic in expected['rosbag2_bagfile_information']['topics_with_message_count']:
        metadata = topic['topic_metadata']
        metadata['offered_qos_profiles'] = profiles[metadata['name']]
    assert yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text()) == expected
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for channel in reader.get_summary().channels.values():
            assert channel.metadata['topic_type_hash'] == FLOAT_HASH
            qos = yaml.safe_load(channel.metadata['offered_qos_profiles'])
            assert qos == profiles[channel.topic]
        (metadata,) = reader.iter_metadata()
        inside = yaml.safe_load(metadata.metadata['serialized_metadata'])
        assert {'rosbag2_bagfile_information': inside} == expected
        got = [
            (channel.topic, schema.name, message.log_time, message.publish_time, decoded.data)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
        ]
    assert got == [
        ('/y', files.FLOAT, 5, 5, 1.5), ('/late', files.FLOAT, 7, 7, -2.5),
        ('/y', files.FLOAT, 9, 9, 2.5),
    ]  # fmt: skip


def recorded(path):
    """Topics appear in between, as in `record`; it flushes twice a second."""
    with BagWriter(path) as bag:
        bag.flush()
        bag.add('/y', files.FLOAT)
        bag.flush()
        for k in range(60_000):
            bag.write('/y', 1000 + k, files.float64(k))
        bag.add('/late', files.JOINTS)
        bag.flush()
        bag.flush()
        bag.add('/description', 'std_msgs/msg/String', qos=[LATCHED_QOS])
        bag.write('/description', 900, files.cdr('std_msgs/msg/String', data='<robot/>'))
        bag.write('/y', 70_000, files.float64(5.0))


def without_messages(path):
    with BagWriter(path) as bag:
        bag.add('/y', files.FLOAT)
        bag.flush()


def replayed(path):
    bag = files.write(path.with_name('source'), files.floats(*files.signal(3000)))
    assert replay.main([str(bag), '-o', str(path)]) == 0


@pytest.mark.parametrize('write', [recorded, without_messages, replayed])
def test_file_is_one_that_the_cpp_reader_takes(write, tmp_path):
    """It refuses files with a chunk that has no complete message index (mcap 1.3.0)."""
    write(tmp_path / 'bag')
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        counts = dict.fromkeys(summary.channels, 0)
        for index in summary.chunk_indexes:
            found = indexed(file, index)
            times = [time for _, time in found]
            assert (index.message_start_time, index.message_end_time) == (min(times), max(times))
            for channel, _ in found:
                counts[channel] += 1
        statistics = summary.statistics
        assert statistics.channel_message_counts == {c: n for c, n in counts.items() if n}
        assert statistics.message_count == sum(counts.values())
        assert statistics.chunk_count == len(summary.chunk_indexes)
        file.seek(0)  # without the index, as a stream: channels come before their messages
        messages = NonSeekingReader(file, validate_crcs=True).iter_messages()
        assert len(list(messages)) == statistics.message_count


def indexed(file, index):
    """Return channel and time of the messages that the indexes of a chunk list: all of them."""
    file.seek(index.chunk_start_offset + 9)
    chunk = Chunk.read(ReadDataStream(file))
    assert chunk.uncompressed_crc
    found = []
    for channel, offset in index.message_index_offsets.items():
        file.seek(offset + 9)
        for time, place in MessageIndex.read(ReadDataStream(file)).records:
            head = struct.unpack_from('<BQHIQ', chunk.data, place)
            assert (head[0], head[2], head[4]) == (Opcode.MESSAGE, channel, time)
            found.append((place, channel, time, place + 9 + head[1]))
    found.sort()
    assert [end for *_, end in found] == [*(place for place, *_ in found[1:]), len(chunk.data)]
    return [(channel, time) for _, channel, time, _ in found]
