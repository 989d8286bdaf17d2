# SPDX-License-Identifier: Apache-2.0
"""Bags have what Jazzy's rosbag2 writes and reads, as seen by readers that are not rosbags."""

import sqlite3

import bag_files as files
from fhaosmo_ros.tools.bags.types import make_qos
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
import yaml

FLOAT_HASH = 'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a'
"""Of std_msgs/msg/Float64 in Jazzy."""
FOREVER = {'sec': 9223372036, 'nsec': 854775807}
RELIABLE = {
    'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile',
    'deadline': FOREVER, 'lifespan': FOREVER, 'liveliness': 'automatic',
    'liveliness_lease_duration': FOREVER, 'avoid_ros_namespace_conventions': False,
}  # fmt: skip
LATCHED = RELIABLE | {'history': 'unknown', 'depth': 0, 'durability': 'transient_local'}
"""As the middleware tells of a publisher: it does not know history and depth."""


def make(path, storage):
    latched = make_qos(
        'UNKNOWN', 0, 'RELIABLE', 'TRANSIENT_LOCAL', 2**63 - 1, 2**63 - 1, 'AUTOMATIC', 2**63 - 1
    )
    with BagWriter(path, storage) as bag:
        bag.add('/y', 'std_msgs/msg/Float64')
        bag.add('/late', 'std_msgs/msg/Float64', qos=[latched])
        bag.write('/y', 5, files.float64(1.5))
        bag.write('/late', 7, files.float64(-2.5))
        bag.write('/y', 9, files.float64(2.5))
    return path


def check(information, storage, file):
    """Every field that rosbag2's parser asks for in version 9, of its type."""
    assert set(information) == {
        'version', 'storage_identifier', 'duration', 'starting_time', 'message_count',
        'topics_with_message_count', 'compression_format', 'compression_mode',
        'relative_file_paths', 'files', 'custom_data', 'ros_distro',
    }  # fmt: skip
    assert information['version'] == 9
    assert information['storage_identifier'] == storage
    assert information['ros_distro'] == 'jazzy'
    assert information['custom_data'] is None  # how yaml-cpp writes an empty map
    times = {'starting_time': {'nanoseconds_since_epoch': 5}, 'duration': {'nanoseconds': 4}}
    assert {key: information[key] for key in times} == times
    assert information['message_count'] == 3
    assert information['files'] == [{'path': file, 'message_count': 3} | times]
    assert information['relative_file_paths'] == [file]
    assert information['compression_format'] == information['compression_mode'] == ''
    topics = {
        topic['topic_metadata']['name']: topic
        for topic in information['topics_with_message_count']
    }
    expected = {'/y': (2, RELIABLE), '/late': (1, LATCHED)}
    assert set(topics) == set(expected)
    for name, (count, qos) in expected.items():
        assert topics[name] == {
            'message_count': count,
            'topic_metadata': {
                'name': name, 'type': 'std_msgs/msg/Float64', 'serialization_format': 'cdr',
                'offered_qos_profiles': [qos], 'type_description_hash': FLOAT_HASH,
            },
        }  # fmt: skip


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_metadata_file(storage, tmp_path):
    bag = make(tmp_path / 'bag', storage)
    content = yaml.safe_load((bag / 'metadata.yaml').read_text())
    assert list(content) == ['rosbag2_bagfile_information']
    suffix = {'mcap': 'mcap', 'sqlite3': 'db3'}[storage]
    check(content['rosbag2_bagfile_information'], storage, f'bag_0.{suffix}')
    assert sorted(p.name for p in bag.iterdir()) == [f'bag_0.{suffix}', 'metadata.yaml']


def test_mcap_file(tmp_path):
    bag = make(tmp_path / 'bag', 'mcap')
    with (bag / 'bag_0.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        assert summary.statistics.message_count == 3
        for channel in summary.channels.values():
            qos = LATCHED if channel.topic == '/late' else RELIABLE
            assert channel.message_encoding == 'cdr'
            assert set(channel.metadata) == {'offered_qos_profiles', 'topic_type_hash'}
            assert channel.metadata['topic_type_hash'] == FLOAT_HASH
            assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == [qos]
            schema = summary.schemas[channel.schema_id]
            assert (schema.name, schema.encoding) == ('std_msgs/msg/Float64', 'ros2msg')
        (metadata,) = reader.iter_metadata()
        assert metadata.name == 'rosbag2'
        information = yaml.safe_load(metadata.metadata['serialized_metadata'])
        check(information, 'mcap', 'bag_0.mcap')
        got = [
            (channel.topic, message.log_time, message.publish_time, decoded.data)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]
    assert got == [('/y', 5, 5, 1.5), ('/late', 7, 7, -2.5), ('/y', 9, 9, 2.5)]


def test_sqlite_file(tmp_path):
    bag = make(tmp_path / 'bag', 'sqlite3')
    with sqlite3.connect(bag / 'bag_0.db3') as database:

        def rows(text):
            return database.execute(text).fetchall()

        assert rows('SELECT * FROM schema') == [(4, 'jazzy')]
        ((version, text),) = rows('SELECT metadata_version, metadata FROM metadata')
        check(yaml.safe_load(text), 'sqlite3', 'bag_0.db3')
        assert version == 9
        topics = rows('SELECT name, offered_qos_profiles, type_description_hash FROM topics')
        assert [t[0] for t in topics] == ['/y', '/late']
        assert yaml.safe_load(topics[1][1]) == [LATCHED]
        assert {t[2] for t in topics} == {FLOAT_HASH}
        definitions = rows('SELECT topic_type, encoding, type_description_hash'
                           ' FROM message_definitions')  # fmt: skip
        assert definitions == [('std_msgs/msg/Float64', 'ros2msg', FLOAT_HASH)]
        got = rows('SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp')
    database.close()
    assert got == [(1, 5, files.float64(1.5)), (2, 7, files.float64(-2.5)),
                   (1, 9, files.float64(2.5))]  # fmt: skip


def test_replayed_bag_is_read_by_another_reader(tmp_path):
    """Chunks that go from file to file as a whole, and those made of estimates."""
    stamps, y = files.signal(3000)
    bag = files.write(tmp_path / 'bag', files.floats(stamps, y))
    assert replay.main([str(bag), '-o', str(tmp_path / 'out')]) == 0
    with (tmp_path / 'out' / 'out_0.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        statistics = reader.get_summary().statistics
        names = {i: c.topic for i, c in reader.get_summary().channels.items()}
        counts = {names[i]: n for i, n in statistics.channel_message_counts.items()}
        assert counts.pop('/y') == 3000
        assert counts.pop('/estimator/parameters') == 1
        assert set(counts.values()) == {3000}
        assert len(counts) == 5
        assert (statistics.message_start_time, statistics.message_end_time) == (
            stamps[0], stamps[-1],
        )  # fmt: skip
        got = [
            (message.log_time, decoded.data)
            for _, _, message, decoded in reader.iter_decoded_messages(topics=['/y'])
        ]
        assert got == list(zip(stamps.tolist(), y.tolist(), strict=True))
        labels = {
            decoded.layout.dim[0].label
            for _, _, _, decoded in reader.iter_decoded_messages(topics=['/estimator/state'])
        }
        assert labels == {'z1,z2,z3'}
        states = reader.iter_decoded_messages(topics=['/estimator/state'])
        assert np.isfinite([decoded.data for _, _, _, decoded in states]).all()
