# SPDX-License-Identifier: Apache-2.0
"""Bags of Humble and Jazzy, of every storage and compression, whole or split, are read alike."""

import bag_files as files
import bag_variants as variants
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import series
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest

COUNT = 1200


@pytest.fixture(scope='module', name='expected')
def _expected(tmp_path_factory):
    """The estimates from a bag that rosbags wrote."""
    folder = tmp_path_factory.mktemp('expected')
    stamps, y = files.signal(COUNT)
    bag = files.write(folder / 'bag', files.floats(stamps, y))
    assert replay.main([str(bag), '-o', str(folder / 'out')]) == 0
    return {
        topic: series(folder / 'out', f'/estimator/{topic}').values
        for topic in ('state', 'unknown_input', 'gamma', 'stamp')
    }


@pytest.mark.parametrize('parts', [1, 3])
@pytest.mark.parametrize('variant', variants.VARIANTS, ids='-'.join)
def test_replay_reads_it(variant, parts, expected, tmp_path, capsys):
    stamps, y = files.signal(COUNT)
    messages = files.floats(stamps, y) + files.floats(stamps + 1, -y, '/other')
    messages.sort(key=lambda m: m[2])
    bag = variants.write(tmp_path / 'bag', messages, *variant, parts)
    out = tmp_path / 'out'
    assert replay.main([str(bag), '-o', str(out)]) == 0, capsys.readouterr()
    for topic, values in expected.items():
        np.testing.assert_array_equal(series(out, f'/estimator/{topic}').values, values)
    other = series(out, '/other')
    np.testing.assert_array_equal(other.stamps, stamps + 1)
    np.testing.assert_array_equal(other.values, -y)
    with BagReader(out) as reader:  # the QoS and the hash go along
        found = next(c for c in reader.connections if c.topic == '/other')
    assert found.ext.offered_qos_profiles[0].depth == 10
    assert found.digest == variants.HASH


@pytest.mark.parametrize('variant', [
    ('humble', 'sqlite3', 'plain'), ('jazzy', 'mcap', 'zstd'), ('jazzy', 'mcap', 'fastwrite'),
    ('humble', 'sqlite3', 'MESSAGE'),
], ids='-'.join)  # fmt: skip
def test_topic_is_read_whole(variant, tmp_path):
    """As plot does."""
    stamps, y = files.signal(300)
    bag = variants.write(tmp_path / 'bag', files.floats(stamps, y), *variant, 2)
    read = series(bag, '/y')
    np.testing.assert_array_equal(read.stamps, stamps)
    np.testing.assert_array_equal(read.values, y)
