# SPDX-License-Identifier: Apache-2.0
"""What an estimator published together is put together again, whatever the recording lacks."""

import bag_files as files
from fhaosmo_ros.tools.bags.topics import read_ticks
import numpy as np
import pytest

COUNT = 200


def record(path, order, missing=()):
    """Write ticks whose numbers are all that of the tick; they come late and in bursts."""
    rng = np.random.default_rng(5)
    begins = np.cumsum(np.where(rng.random(COUNT) < 0.2, 300_000, 10_000_000))
    messages = []
    for k, begin in enumerate(begins.tolist()):
        pauses = np.cumsum(rng.integers(1_000, 50_000, len(order)))
        for part, pause in zip(order, pauses.tolist(), strict=True):
            if (k, part) not in missing:
                messages.append((
                    f'/e/{part}', 'std_msgs/msg/Float64', begin + pause, files.float64(float(k)),
                ))  # fmt: skip
    return files.write(path, messages)


@pytest.mark.parametrize(
    ('order', 'missing'),
    [
        ('abc', ()),
        ('abc', {(0, 'a'), (0, 'b')}),
        ('abc', {(0, 'c'), (COUNT - 1, 'c'), (COUNT - 1, 'b')}),
        ('abc', {(77, 'b'), (78, 'a'), (78, 'c')}),
        ('cab', {(0, 'c'), (50, 'b')}),
        ('bca', {(COUNT - 1, 'a')}),
    ],
)
def test_ticks_are_whole(order, missing, tmp_path):
    ticks = read_ticks(record(tmp_path / 'bag', order, missing), '/e', 'abc')
    np.testing.assert_array_equal(ticks['a'], ticks['c'])
    np.testing.assert_array_equal(ticks['b'], ticks['c'])
    broken = {k for k, _ in missing}
    np.testing.assert_array_equal(ticks['c'], [k for k in range(COUNT) if k not in broken])


def test_empty_topic_gives_no_ticks(tmp_path):
    bag = record(tmp_path / 'bag', 'ab')
    ticks = read_ticks(bag, '/e', 'abc')
    assert [len(column) for column in ticks.values()] == [0, 0, 0]
