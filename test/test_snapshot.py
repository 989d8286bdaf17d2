# SPDX-License-Identifier: Apache-2.0
"""A snapshot holds all that an estimator needs to go on bit for bit."""

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.memory import Flag, labels, pack, Snapshot, unpack
from fhaosmo_ros.core.parameters.errors import ConfigurationError
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
    {'noise_size': 1e-3},
    {'structure': 'levant', 'scheme': 'predict_correct', 'correction_period': 1e-3,
     'lambda': [8.0, 20.0, 30.0, 16.0], 'fuzzy_widths': [0.1], 'noise_size': 1e-3},
])  # fmt: skip
def test_another_estimator_goes_on_bit_for_bit(parameters):
    first, second = OnlineEstimator(parameters), OnlineEstimator(parameters)
    feed(first, 0, 1500)
    first.set_input(0.25)
    kept = pack(Snapshot(first.latest, Flag.CHANGED, first.memory))
    assert len(kept) == len(labels(first.observer.levels))
    snapshot = unpack(kept.tolist(), labels(first.observer.levels))
    assert snapshot.stamp == first.stamp
    assert snapshot.flags == Flag.CHANGED
    feed(second, 0, 100)  # whatever it was before
    second.remember(snapshot.memory)
    assert second.inputs == (0.25,)
    assert second.stamp == first.stamp
    np.testing.assert_array_equal(feed(second, 1500, 3000), feed(first, 1500, 3000))


def test_labels_name_what_stands_there():
    estimator = OnlineEstimator()
    feed(estimator, 0, 700)
    vector = pack(Snapshot(estimator.latest, Flag(0), estimator.memory))
    entries = dict(zip(labels(estimator.observer.levels), vector.tolist(), strict=True))
    assert len(entries) == len(vector)  # no name twice
    state = estimator.observer.state
    assert entries['z_hat2'] == state.levels[0, 1]
    assert entries['z_tilde1'] == state.levels[1, 0]
    assert entries['gamma'] == estimator.estimate.gamma
    assert entries['y'] == state.memory[1]
    assert int(entries['stamp_upper']) * 2**32 + int(entries['stamp_lower']) == estimator.stamp
    assert int(entries['sec']) * 10**9 + int(entries['nanosec']) == estimator.stamp


@pytest.mark.parametrize('integer', [0, 1, -1, 2**63 - 1, -(2**63), 1_700_000_000_123_456_789])
def test_integers_come_back_exactly(integer):
    memory = OnlineEstimator().memory
    memory.integers[:] = integer
    back = unpack(pack(Snapshot(5, Flag(0), memory)), labels(4))
    np.testing.assert_array_equal(back.memory.integers, memory.integers)


@pytest.mark.parametrize('names', [
    [], ['flags'], [*labels(4)[:-1], 'u', 'u'], [*labels(4), 'mystery'], [*labels(4), 'z_hat9'],
])  # fmt: skip
def test_vector_of_other_entries_is_refused(names):
    with pytest.raises(ValueError, match='entries'):
        unpack(np.zeros(len(names)), names)
    with pytest.raises(ValueError, match='8 entries'):
        unpack(np.zeros(8), labels(4))


def test_what_an_older_version_did_not_remember_is_0():
    vector = pack(Snapshot(5, Flag(0), OnlineEstimator().memory)) + 1.0
    names = labels(4)
    k = names.index('lost_since_upper')
    old = np.delete(vector, [k, k + 1])
    found = unpack(old, names[:k] + names[k + 2 :])
    wanted = np.array(vector)
    wanted[[k, k + 1]] = 0.0
    np.testing.assert_array_equal(pack(found), wanted)


def test_snapshot_of_several_inputs():
    parameters = {'order': 2, 'phi': ['0', 'a - b'], 'inputs': ['a', 'b'], 'gains': 'fixed'}
    first, second = OnlineEstimator(parameters), OnlineEstimator(parameters)
    first.set_input(0.5, 0)
    first.set_input(-2.0, 1)
    feed(first, 0, 50)
    names = labels(first.observer.levels, first.observer.inputs)
    second.remember(unpack(pack(Snapshot(first.latest, Flag(0), first.memory)), names).memory)
    assert second.inputs == (0.5, -2.0)
    np.testing.assert_array_equal(feed(second, 50, 90), feed(first, 50, 90))
    with pytest.raises(ConfigurationError, match='1 known inputs, got 2'):
        OnlineEstimator(parameters | {'inputs': ['u'], 'phi': ['0', 'u']}).remember(first.memory)


def test_memory_of_another_size_is_refused_and_changes_nothing():
    estimator = OnlineEstimator()
    feed(estimator, 0, 100)
    before = estimator.memory
    with pytest.raises(ConfigurationError, match='4 levels'):
        estimator.remember(
            OnlineEstimator({'order': 2, 'phi': ['0', '0'], 'gains': 'fixed'}).memory
        )
    for mine, was in zip(estimator.memory, before, strict=True):
        np.testing.assert_array_equal(mine, was)


@pytest.mark.parametrize('scheme', ['implicit', 'explicit'])
def test_snapshot_without_the_covariance_is_followed(scheme):
    """As of an older version, which remembered less."""
    parameters = {'scheme': scheme, 'structure': 'levant', 'lambda': [8.0, 20.0, 30.0, 16.0]}
    first, second = OnlineEstimator(parameters), OnlineEstimator(parameters)
    feed(first, 0, 1500)
    later = ('covariance', 'scale', 'saturated', 'beyond', 'settled', 'period', 'spread')
    vector = pack(Snapshot(first.latest, Flag.CHANGED, first.memory))
    kept = {
        label: value
        for label, value in zip(labels(first.observer.levels), vector, strict=True)
        if not label.removeprefix('before_').startswith(later)
    }
    assert len(kept) < len(vector)
    second.remember(unpack(list(kept.values()), list(kept)).memory)
    np.testing.assert_array_equal(feed(second, 1500, 3000), feed(first, 1500, 3000))
