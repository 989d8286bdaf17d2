# SPDX-License-Identifier: Apache-2.0
"""Bags of Humble and Jazzy, of every storage and compression, whole or split, are read alike."""

import bag_files as files
import bag_variants as variants
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import read_ticks, series
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest

COUNT = 1200


@pytest.fixture(scope='module', name='expected')
def _expected():
    """What a node would estimate: one sample after the other."""
    stamps, y = files.signal(COUNT)
    estimator, rows = OnlineEstimator(), []
    for stamp, sample in zip(stamps.tolist(), y.tolist(), strict=True):
        e = estimator.update(stamp, sample)
        rows.append([*e.z, e.unknown_input, e.gamma])
    return np.array(rows)


@pytest.mark.parametrize('parts', [1, 3])
@pytest.mark.parametrize('variant', variants.VARIANTS, ids='-'.join)
def test_replay_reads_it(variant, parts, expected, tmp_path, capsys):
    stamps, y = files.signal(COUNT)
    messages = files.floats(stamps, y) + files.floats(stamps + 1, -y, '/other')
    messages.sort(key=lambda m: m[2])
    bag = variants.write(tmp_path / 'bag', messages, *variant, parts)
    out = tmp_path / 'out'
    assert replay.main([str(bag), '-o', str(out)]) == 0, capsys.readouterr()
    found = read_ticks(out, '/estimator', ['state', 'unknown_input', 'gamma', 'stamp'])
    np.testing.assert_array_equal(found.pop('stamp'), stamps)
    np.testing.assert_array_equal(np.column_stack(list(found.values())), expected)
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


def test_fastwrite_out_of_order_is_put_in_order(tmp_path):
    """Messages outside chunks, a few milliseconds late at random."""
    stamps, y = files.signal(3000)
    messages = files.floats(stamps, y)
    order = np.argsort(np.arange(3000) + np.random.default_rng(3).uniform(0, 7, 3000))
    late = [messages[k] for k in order]
    bag = variants.write(tmp_path / 'bag', late, 'jazzy', 'mcap', 'fastwrite')
    np.testing.assert_array_equal(series(bag, '/y').values, y)
