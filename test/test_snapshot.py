# SPDX-License-Identifier: Apache-2.0
"""A snapshot holds all that an estimator needs to go on bit for bit."""

from fhaosmo_ros.core.observer import ObserverState
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.snapshot import Flag, labels, pack, Snapshot, unpack
import numpy as np
import pytest

ORIGIN = 1_700_000_000_123_456_789


def feed(estimator, begin, end):
    rng = np.random.default_rng(3)
    jitter = rng.integers(-200_000, 200_000, 4000)
    rows = []
    for k in range(begin, end):
        stamp = ORIGIN + k * 1_000_000 + int(jitter[k])
        e = estimator.update(stamp, float(0.2 + 0.1 * np.sin(3e-3 * k)))
        rows.append([*e.z, e.unknown_input, e.gamma, *e.innovation])
    return np.array(rows)


@pytest.mark.parametrize('parameters', [
    {'variant': 'fuzzy_adaptive'}, {'variant': 'sign', 'order': 2, 'phi': ['0', '-z2']},
    {'scheme': 'explicit', 'variant': 'fuzzy_adaptive'},
])  # fmt: skip
def test_another_estimator_goes_on_bit_for_bit(parameters):
    first, second = OnlineEstimator(parameters), OnlineEstimator(parameters)
    feed(first, 0, 1500)
    kept = pack(Snapshot(first.stamp, Flag.CHANGED, first.timing, first.observer.state))
    assert len(kept) == len(labels(first.observer.levels))
    snapshot = unpack(kept.tolist())
    assert snapshot.stamp == first.stamp
    assert snapshot.flags == Flag.CHANGED
    feed(second, 0, 100)  # whatever it was before
    second.resume(snapshot.stamp, snapshot.state, snapshot.timing)
    np.testing.assert_array_equal(feed(second, 1500, 3000), feed(first, 1500, 3000))


def test_labels_name_what_stands_there():
    state = ObserverState(np.arange(12.0).reshape(4, 3), np.array([0.5, 7.0, 0.0]))
    entries = dict(
        zip(labels(3), pack(Snapshot(5, Flag(0), np.array([16.0, 1e6, 2.0]), state)), strict=True)
    )
    assert entries['z_hat2'] == 1.0
    assert entries['z_tilde1'] == 3.0
    assert entries['gamma'] == 0.5
    assert entries['interval'] == 1e6
    assert entries['y'] == 7.0


@pytest.mark.parametrize('size', [0, 6, 11, 20])
def test_vector_of_another_length_is_refused(size):
    with pytest.raises(ValueError, match=f'{size} entries'):
        unpack(np.zeros(size))
