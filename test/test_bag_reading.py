# SPDX-License-Identifier: Apache-2.0
"""Bags of every storage are read alike; a damaged one gives the right samples or an error."""

from itertools import product
import sqlite3

import bag_files as files
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import read_ticks, series
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest

COUNT = 1500
STAMPS, Y = files.signal(COUNT)
BY_ROSBAGS = list(product(('mcap', 'sqlite3'), ('none', 'file', 'message')))


def make(path, how):
    if how != 'ours':
        write = files.write if how == 'sqlite3' else files.write_preset
        return write(path, files.floats(STAMPS, Y), how)
    with BagWriter(path) as bag:
        bag.add('/y', files.FLOAT)
        for k, (topic, _, stamp, data) in enumerate(files.floats(STAMPS, Y)):
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


# Whole bags


def messages():
    both = files.floats(STAMPS, Y) + files.floats(STAMPS + 1, -Y, '/other')
    return sorted(both, key=lambda m: m[2])


@pytest.mark.parametrize('parts', [1, 3])
@pytest.mark.parametrize('preset', files.PRESETS)
def test_presets_of_mcap(preset, parts, tmp_path):
    bag = files.write_preset(tmp_path / 'bag', messages(), preset, parts=parts)
    assert read(bag) == COUNT
    other = series(bag, '/other')
    np.testing.assert_array_equal(other.stamps, STAMPS + 1)
    np.testing.assert_array_equal(other.values, -Y)


@pytest.mark.parametrize('version', [8, 9])
@pytest.mark.parametrize('how', BY_ROSBAGS, ids='-'.join)
def test_bags_of_rosbags(how, version, tmp_path):
    bag = files.write(tmp_path / 'bag', messages(), *how, version=version)
    assert read(bag) == COUNT
    if 'file' not in how:  # without metadata.yaml, which says whether messages are compressed
        assert read(storage_file(bag)) == COUNT


@pytest.mark.parametrize('preset', ['plain', 'fastwrite'])
def test_messages_and_chunks_out_of_order_are_put_in_order(preset, tmp_path):
    order = np.argsort(np.arange(COUNT) + np.random.default_rng(3).uniform(0, 700, COUNT))
    shuffled = [files.floats(STAMPS, Y)[k] for k in order]
    assert read(files.write_preset(tmp_path / 'bag', shuffled, preset)) == COUNT


def test_bag_whose_qos_differs_from_its_storage_is_read(tmp_path):
    """rosbags finds no message then."""
    bag = files.write(tmp_path / 'bag', files.floats(STAMPS, Y))
    text = (bag / 'metadata.yaml').read_text()
    qos = '[{history: keep_last, depth: 3, reliability: reliable, durability: volatile, '
    zero = '{sec: 0, nsec: 0}'
    qos += f'deadline: {zero}, lifespan: {zero}, liveliness: automatic, '
    qos += f'liveliness_lease_duration: {zero}, avoid_ros_namespace_conventions: false}}]'
    assert 'offered_qos_profiles: []' in text
    (bag / 'metadata.yaml').write_text(
        text.replace('offered_qos_profiles: []', f'offered_qos_profiles: {qos}')
    )
    assert read(bag) == COUNT


# Damage


@pytest.mark.parametrize('how', ['ours', 'zstd', 'lz4'])
def test_damage_in_a_file_with_checksums_is_an_error(how, tmp_path):
    """Single bits and zeros, half of them in the summary: topics, types and where chunks are."""
    bag = make(tmp_path / 'bag', how)
    file = storage_file(bag)
    whole = file.read_bytes()
    rng = np.random.default_rng(17)
    results = []
    for k in range(40):
        data = bytearray(whole)
        end = len(whole)
        at = int(rng.integers(0, end) if k % 2 else end - rng.integers(1, 1200))
        if k % 4 < 2:
            data[at] ^= 1 << int(rng.integers(8))
        else:
            data[at:end] = (bytes(512) + data[at + 512 : end])[: end - at]
        file.write_bytes(data)
        results += [read(bag), read(file)]
    assert set(results) <= {COUNT, None}
    assert results.count(None) > 40


def test_summary_that_differs_from_its_checksum_is_an_error(tmp_path):
    """Such as another topic's name, which reads as well."""
    file = storage_file(make(tmp_path / 'bag', 'ours'))
    data = bytearray(file.read_bytes())
    at = data.rindex(b'/y')
    data[at : at + 2] = b'/z'
    file.write_bytes(data)
    with pytest.raises(ConfigurationError, match='summary does not agree with its CRC'):
        BagReader(file)


@pytest.mark.parametrize('share', [0.999, 0.99, 0.72, 0.3, 0.001])
@pytest.mark.parametrize('how', ['ours', 'lz4', 'fastwrite', 'sqlite3'])
def test_file_that_was_cut_is_an_error(how, share, tmp_path):
    """As after a kill of the recorder, or on a full disk; metadata.yaml is missing then."""
    bag = make(tmp_path / 'bag', how)
    whole = storage_file(bag).read_bytes()
    storage_file(bag).write_bytes(whole[: int(share * len(whole))])
    assert read(bag) is read(storage_file(bag)) is None
    whole_bag = pytest.raises(ConfigurationError, match=r'whole bag.*mcap recover')
    with whole_bag, BagReader(bag) as reader:
        assert how == 'sqlite3'  # where it may be found only by reading
        list(reader.messages())
    storage_file(bag).with_name(f'{storage_file(bag).name}-journal').touch()
    with pytest.raises(ConfigurationError, match=r'writer was killed: `sqlite3 .* \.tables`'):
        BagReader(storage_file(bag))


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_messages_that_are_listed_and_not_there_are_an_error(storage, tmp_path, capsys):
    bag = files.write(tmp_path / 'bag', files.floats(STAMPS, Y), storage)
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


@pytest.mark.parametrize(('how', 'told'), [('zstd', 0), ('zstd_fast', 1), ('fastwrite', 1)])
def test_bag_without_checksums_is_told_once(how, told, tmp_path, capsys):
    assert replay.main([str(make(tmp_path / 'bag', how)), '-o', str(tmp_path / 'out.npz')]) == 0
    assert capsys.readouterr().out.count('no checksums') == told


# `ros2 bag record` writes the time of reception as log time, the source's as publish time.


@pytest.fixture(name='late')
def _late():
    """Reception: up to 66 ms late, in the order of publication, no two at the same time."""
    late = STAMPS + np.random.default_rng(5).integers(0, 66_000_000, COUNT)
    return np.maximum.accumulate(late) + np.arange(COUNT)


def replayed(bag, folder, *arguments):
    out = folder / 'out.npz'
    assert replay.main([str(bag), '-o', str(out), '--force', *arguments]) == 0
    with np.load(out) as arrays:
        return arrays['unknown_input'], arrays['stamp_ns']


@pytest.mark.parametrize('preset', ['zstd', 'fastwrite'])
def test_replay_takes_the_source_stamps(preset, late, tmp_path, capsys):
    bag = files.write_preset(tmp_path / 'bag', files.floats(late, Y), preset, STAMPS)
    d, stamps = replayed(bag, tmp_path)
    assert 'stamps: source' in capsys.readouterr().out
    np.testing.assert_array_equal(stamps, STAMPS)
    live = OnlineEstimator()
    pairs = zip(STAMPS.tolist(), Y.tolist(), strict=True)
    np.testing.assert_array_equal(d, [live.update(t, y).unknown_input for t, y in pairs])
    np.testing.assert_array_equal(replayed(bag, tmp_path, '-p', 'input_stamp:=source')[0], d)
    received, stamps = replayed(bag, tmp_path, '-p', 'input_stamp:=reception')
    assert 'stamps: bag' in capsys.readouterr().out
    np.testing.assert_array_equal(stamps, late)
    assert not np.array_equal(received, d)
    # An estimator that used its clock got them at the times of reception.
    np.testing.assert_array_equal(replayed(bag, tmp_path, '-p', 'sampling:=clock')[1], late)


def test_publish_time_that_its_writer_did_not_know(tmp_path, capsys):
    bag = files.write_preset(tmp_path / 'bag', files.floats(STAMPS, Y), 'plain', 0 * STAMPS)
    np.testing.assert_array_equal(replayed(bag, tmp_path)[1], STAMPS)
    assert 'stamps: bag' in capsys.readouterr().out


# What an estimator published together is put together again, whatever the recording lacks


TICKS = 200


def write_ticks(path, order, missing=()):
    """Write ticks whose numbers are all that of the tick; they come late and in bursts."""
    rng = np.random.default_rng(5)
    begins = np.cumsum(np.where(rng.random(TICKS) < 0.2, 300_000, 10_000_000))
    messages = []
    for k, begin in enumerate(begins.tolist()):
        pauses = np.cumsum(rng.integers(1_000, 50_000, len(order)))
        for part, pause in zip(order, pauses.tolist(), strict=True):
            if (k, part) not in missing:
                messages.append((
                    f'/e/{part}', 'std_msgs/msg/Float64', begin + pause, files.float64(float(k)),
                ))  # fmt: skip
    return files.write(path, messages)


@pytest.mark.parametrize(('order', 'missing'), [
    ('abc', ()),
    ('abc', {(0, 'a'), (0, 'b')}),
    ('abc', {(0, 'c'), (TICKS - 1, 'c'), (TICKS - 1, 'b')}),
    ('abc', {(77, 'b'), (78, 'a'), (78, 'c')}),
    ('cab', {(0, 'c'), (50, 'b')}),
    ('bca', {(TICKS - 1, 'a')}),
    ('abc', {(k, 'c') for k in range(TICKS)}),
])  # fmt: skip
def test_ticks_are_whole(order, missing, tmp_path):
    ticks = read_ticks(write_ticks(tmp_path / 'bag', order, missing), '/e', 'abc')
    np.testing.assert_array_equal(ticks['a'], ticks['c'])
    np.testing.assert_array_equal(ticks['b'], ticks['c'])
    broken = {k for k, _ in missing}
    np.testing.assert_array_equal(ticks['c'], [k for k in range(TICKS) if k not in broken])
