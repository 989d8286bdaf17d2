# SPDX-License-Identifier: Apache-2.0
"""
Bags of every storage are read alike, and a damaged one gives the right samples or an error.

Those that are written have what Jazzy's rosbag2 writes and reads, as seen by other readers.
"""

import sqlite3
import struct

import bag_files as files
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.recorded import read_ticks
from fhaosmo_ros.tools.bags.types import LATCHED_QOS, OFFERED_QOS
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader, NonSeekingReader
from mcap.records import Chunk, MessageIndex
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
import yaml

COUNT = 1500
STAMPS, Y = files.signal(COUNT)
FLOATS = files.floats(STAMPS, Y)


def make(path, how):
    """Write a bag by our writer, by rosbags with sqlite3, or as a preset of mcap."""
    if how != 'ours':
        write = files.write if how == 'sqlite3' else files.write_preset
        return write(path, FLOATS, how)
    with BagWriter(path) as bag:
        bag.add('/y', files.FLOAT)
        for k, (topic, _, stamp, data) in enumerate(FLOATS):
            bag.write(topic, stamp, data)
            if k % 250 == 0:  # as the recorder does, now and then
                bag.flush()
    return path


def storage_file(bag):
    (file,) = [p for p in bag.iterdir() if p.suffix in ('.mcap', '.db3')]
    return file


def read(path):
    """Return how many samples are read, all of them right; None for an error in one line."""
    try:
        with BagReader(path) as reader:
            times, stamps, values = reader.samples('/y', reader.field('/y', None), 'auto')
    except ConfigurationError as error:
        return None if '\n' not in str(error) else 'several lines'
    for column, expected in ((times, STAMPS), (stamps, STAMPS), (values, Y)):
        np.testing.assert_array_equal(column, expected[: len(column)])
    return len(values)


@pytest.mark.parametrize(('storage', 'compression', 'version'), [
    *((preset, None, 9) for preset in files.PRESETS),
    ('mcap', 'none', 8), ('mcap', 'message', 9),
    ('sqlite3', 'none', 8), ('sqlite3', 'file', 9), ('sqlite3', 'message', 8),
])  # fmt: skip
def test_every_storage_and_compression_is_read(storage, compression, version, tmp_path):
    """Presets of mcap in three files, and bags of rosbags."""
    messages = FLOATS + files.floats(STAMPS + 1, -Y, '/other')
    messages.sort(key=lambda m: m[2])
    if storage in files.PRESETS:
        bag = files.write_preset(tmp_path / 'bag', messages, storage, parts=3)
    else:
        bag = files.write(tmp_path / 'bag', messages, storage, compression, version)
        if compression != 'file':  # without metadata.yaml, which says how it is compressed
            assert read(storage_file(bag)) == COUNT
    assert read(bag) == COUNT
    with BagReader(bag) as reader:
        other = reader.samples('/other', reader.field('/other', None))
    np.testing.assert_array_equal(other.stamps, STAMPS + 1)
    np.testing.assert_array_equal(other.values, -Y)


@pytest.mark.parametrize('preset', ['plain', 'fastwrite'])
def test_messages_and_chunks_out_of_order_are_put_in_order(preset, tmp_path):
    order = np.argsort(np.arange(COUNT) + np.random.default_rng(3).uniform(0, 700, COUNT))
    assert read(files.write_preset(tmp_path / 'bag', [FLOATS[k] for k in order], preset)) == COUNT
    damaged = files.write_preset(tmp_path / 'late', [('/y', files.FLOAT, 2**63, b'')], preset)
    assert read(damaged) is None


def test_bag_whose_qos_differs_from_its_storage_is_read(tmp_path):
    """rosbags finds no message then."""
    bag = files.write(tmp_path / 'bag', FLOATS)
    text = (bag / 'metadata.yaml').read_text()
    assert 'profiles: []' in text
    (bag / 'metadata.yaml').write_text(
        text.replace('_profiles: []', f'_profiles: [{OFFERED_QOS}]')
    )
    assert read(bag) == COUNT


@pytest.mark.parametrize('how', ['ours', 'zstd', 'lz4', 'fastwrite_crc'])
def test_damage_in_a_file_with_checksums_is_an_error(how, tmp_path):
    """Single bits and zeros, half of them in the summary: topics, types and where chunks are."""
    bag = make(tmp_path / 'bag', how)
    file = storage_file(bag)
    whole = file.read_bytes()
    rng = np.random.default_rng(17)
    results = []
    for k in range(40):
        data = bytearray(whole)
        at = int(rng.integers(0, len(whole)) if k % 2 else len(whole) - rng.integers(1, 1200))
        if k % 4 < 2:
            data[at] ^= 1 << int(rng.integers(8))
        else:
            data[at : at + 512] = bytes(len(data[at : at + 512]))
        file.write_bytes(data)
        results += [read(bag), read(file)]
    assert set(results) <= {COUNT, None}
    assert results.count(None) > 40
    before, _, after = whole.rpartition(b'/y')
    file.write_bytes(before + b'/z' + after)  # another topic's name, which reads as well
    with pytest.raises(ConfigurationError, match='does not agree with its CRC'):
        BagReader(file)


@pytest.mark.parametrize('how', ['ours', 'lz4', 'fastwrite', 'sqlite3'])
def test_file_that_was_cut_is_an_error(how, tmp_path):
    """As after a kill of the recorder, or on a full disk; metadata.yaml is missing then."""
    bag = make(tmp_path / 'bag', how)
    file = storage_file(bag)
    whole = file.read_bytes()
    for share in (0.999, 0.72, 0.3, 0.001):
        file.write_bytes(whole[: int(share * len(whole))])
        assert read(bag) is read(file) is None
    file.with_name(f'{file.name}-journal').touch()
    with pytest.raises(ConfigurationError, match=r'writer was killed: `sqlite3 .* \.tables`'):
        BagReader(file)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_messages_that_are_listed_and_not_there_are_an_error(storage, tmp_path, capsys):
    bag = files.write(tmp_path / 'bag', FLOATS, storage)
    if storage == 'mcap':
        text = (bag / 'metadata.yaml').read_text()
        (bag / 'metadata.yaml').write_text(text.replace('count: 1500', 'count: 1510'))
    else:
        with sqlite3.connect(bag / 'bag.db3') as database:
            database.execute('DELETE FROM messages WHERE id > 1490')
        database.close()
    assert replay.main([str(bag), '-o', str(tmp_path / 'out.npz')]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert 'messages on /y' in line
    assert '`mcap recover`' in line


# `ros2 bag record` writes the time of reception as log time, the source's as publish time.


@pytest.mark.parametrize('preset', ['zstd', 'fastwrite'])
def test_replay_takes_the_source_stamps(preset, tmp_path, capsys):
    late = STAMPS + np.random.default_rng(5).integers(0, 66_000_000, COUNT)
    late = np.maximum.accumulate(late) + np.arange(COUNT)  # in the order of publication
    bag = files.write_preset(tmp_path / 'bag', files.floats(late, Y), preset, STAMPS)
    unknown = files.write_preset(tmp_path / 'unknown', files.floats(late, Y), preset, 0 * STAMPS)
    for path, option, stamps, said in (
        (bag, 'input_stamp:=auto', STAMPS, 'source'),
        (bag, 'input_stamp:=source', STAMPS, 'source'),
        (bag, 'input_stamp:=reception', late, 'bag'),
        (bag, 'sampling:=clock', late, 'bag'),  # such a node took its own clock
        (unknown, 'input_stamp:=auto', late, 'bag'),  # its writer did not know publish times
    ):
        out = tmp_path / 'out.npz'
        assert replay.main([str(path), '-o', str(out), '--force', '-p', option]) == 0
        assert f'stamps: {said}' in capsys.readouterr().out
        run = OnlineEstimator(sampling='clock' if 'clock' in option else 'source_stamp')
        expected = run.run(stamps, Y)
        if stamps is STAMPS:  # the others come in bursts, and are placed on a line
            np.testing.assert_array_equal(expected.t, stamps)
        with np.load(out) as found:
            np.testing.assert_array_equal(found['stamp_ns'], expected.t)
            np.testing.assert_array_equal(found['unknown_input'], expected.unknown_input)


# What an estimator published together is put together again, whatever the recording lacks

TICKS = 200


def write_ticks(path, order, missing):
    """Write ticks whose numbers are all that of the tick; they come late and in bursts."""
    rng = np.random.default_rng(5)
    begins = np.cumsum(np.where(rng.random(TICKS) < 0.2, 300_000, 10_000_000))
    messages = []
    for k, begin in enumerate(begins.tolist()):
        pauses = np.cumsum(rng.integers(1_000, 50_000, len(order)))
        for part, at in zip(order, (begin + pauses).tolist(), strict=True):
            if (k, part) not in missing:
                messages.append((f'/e/{part}', files.FLOAT, at, files.float64(float(k))))
    return files.write(path, messages)


@pytest.mark.parametrize(('order', 'missing'), [
    ('abc', {(0, 'a'), (0, 'b'), (77, 'b'), (78, 'a'), (78, 'c')}),
    ('abc', {(0, 'c'), (TICKS - 1, 'c'), (TICKS - 1, 'b')}),
    ('cab', {(0, 'c'), (50, 'b')}),
    ('abc', {(k, 'c') for k in range(TICKS)}),
])  # fmt: skip
def test_ticks_are_whole(order, missing, tmp_path):
    with BagReader(write_ticks(tmp_path / 'bag', order, missing)) as reader:
        ticks = read_ticks(reader, '/e', 'abc')
    np.testing.assert_array_equal(ticks['a'], ticks['c'])
    np.testing.assert_array_equal(ticks['b'], ticks['c'])
    broken = {k for k, _ in missing}
    np.testing.assert_array_equal(ticks['c'], [k for k in range(TICKS) if k not in broken])


# Bags that are written

FLOAT_HASH = 'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a'
"""Of std_msgs/msg/Float64 in Jazzy."""
SEEN_QOS = LATCHED_QOS | {'history': 'unknown', 'depth': 0}
"""As the middleware tells of a publisher: it does not know history and depth."""


def test_metadata_is_as_rosbag2_writes_it(tmp_path):
    """As that of rosbags; and again in the file, where the parser of the C++ reader looks."""
    written = [('/y', 5, 1.5), ('/late', 7, -2.5), ('/y', 9, 2.5)]
    messages = [(topic, files.FLOAT, t, files.float64(value)) for topic, t, value in written]
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
            (channel.topic, message.publish_time, decoded.data)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]
    assert got == written


@pytest.mark.parametrize('count', [0, 60_000])
def test_file_is_one_that_the_cpp_reader_takes(count, tmp_path):
    """It refuses files with a chunk that has no complete message index (mcap 1.3.0)."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('/y', files.FLOAT)
        bag.flush()
        for k in range(count):
            bag.write('/y', 1000 + k, files.float64(k))
        bag.add('/late', files.FLOAT)  # a topic that appears in between
        bag.flush()
        if count:
            bag.write('/late', 900, files.float64(5.0))
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
