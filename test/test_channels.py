# SPDX-License-Identifier: Apache-2.0
"""Channels stepped together are, bit for bit, estimators stepped alone, whatever the samples."""

from fhaosmo_ros.core.online.batch import EstimatorBatch
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

MS = 1_000_000
PARAMETERS = [
    {},
    {'order': 1, 'phi': ['-z1'], 'unknown_input': False, 'variant': 'sign'},
    {'order': 2, 'phi': ['0', 'u - sin(z1)'], 'variant': 'fuzzy', 'scheme': 'explicit'},
    {'order': 5, 'phi': ['0', '0', '0', '0', '-z5'], 'estimate_from': 'filtered'},
    {'sampling': 'nominal', 'spike_gate': 0.05},
]
PERIODS = [MS, MS, MS, 2 * MS, 0, -MS, 40 * MS, 501 * MS, -700 * MS]
VALUES = [0.0, 0.1, 0.2, -0.3, float('nan'), float('inf'), 1e300]
LIVE = [{'lambda': [20.0]}, {'epsilon': 0.05}, {'estimate_from': 'filtered'}]
SAMPLES = st.lists(
    st.tuples(
        st.integers(0, len(PARAMETERS) - 1), st.sampled_from(PERIODS), st.sampled_from(VALUES),
        st.sampled_from([0.0, 0.5]),
    ),
    min_size=1, max_size=60,
)  # fmt: skip


class Alone:
    """The reference: each estimator by itself."""

    def __init__(self):
        self.estimators = [OnlineEstimator(p) for p in PARAMETERS]

    def advance(self, channel, stamps, y, u):
        rows = []
        for c, *sample, known in zip(channel, stamps, y, u, strict=True):
            self.estimators[c].set_input(known)
            rows.append((self.estimators[c].advance(*sample), self._unknown_input(c)))
        return map(np.array, zip(*rows, strict=True))

    def _unknown_input(self, c):
        return self.estimators[c].observer.unknown_input


def assert_same_state(one, other):
    ours, theirs = one.state_dict(), other.state_dict()
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - {'u'}:  # inputs of a sample in a batch are not held
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert one.counters == other.counters
    assert one.stamp == other.stamp
    assert (one.estimate is None) == (other.estimate is None)
    if one.estimate is not None:
        assert one.estimate.word == other.estimate.word
        np.testing.assert_array_equal(one.estimate.z, other.estimate.z)


@given(SAMPLES, st.integers(1, 20))
def test_any_samples(samples, size):
    alone = Alone()
    together = [OnlineEstimator(p) for p in PARAMETERS]
    channels = EstimatorBatch(together)
    now = [10**18] * len(PARAMETERS)
    columns = []
    for c, period, y, u in samples:
        now[c] += period
        columns.append((c, now[c], y, u))
    for k in range(0, len(columns), size):
        part = [list(column) for column in zip(*columns[k : k + size], strict=True)]
        expected = alone.advance(*part)
        for got, wanted in zip(channels.advance(*part), expected, strict=True):
            np.testing.assert_array_equal(got, wanted)
    for one, other in zip(alone.estimators, together, strict=True):
        assert_same_state(one, other)


@pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
def test_a_long_run_of_many(scheme):
    rng = np.random.default_rng(2)
    count = 2000
    channel = rng.integers(0, 8, count).tolist()
    stamps = (10**18 + np.cumsum(rng.integers(50_000, 200_000, count))).tolist()
    y = (0.2 + 0.1 * np.sin(np.arange(count) * 1e-3)).tolist()
    parameters = [{'scheme': scheme, 'lambda': 10.0 + c} for c in range(8)]
    alone = [OnlineEstimator(p) for p in parameters]
    for sample in zip(channel, stamps, y, strict=True):
        alone[sample[0]].advance(*sample[1:])
    together = [OnlineEstimator(p) for p in parameters]
    words, _ = EstimatorBatch(together).advance(channel, stamps, y, [0.0] * count)
    assert len(words) == count
    for one, other in zip(alone, together, strict=True):
        assert one.counters.accepted > 100
        assert_same_state(one, other)


def test_single_steps_between_are_taken_along():
    """The arrays are the estimators' own: reset, seed and single samples act at once."""
    one, two = OnlineEstimator(), OnlineEstimator()
    channels = EstimatorBatch([one])
    for k in range(50):
        stamp, y = 10**18 + k * MS, 0.1 * k
        two.advance(stamp, y)
        if k % 3:
            one.advance(stamp, y)
        else:
            channels.advance([0], [stamp], [y], [0.0])
        if k == 20:
            one.reset()
            two.reset()
        if k == 30:
            one.seed([1.0, 2.0, 3.0], 4.0)
            two.seed([1.0, 2.0, 3.0], 4.0)
    assert_same_state(one, two)


@pytest.mark.parametrize('change', LIVE)
def test_changes_act_from_the_next_sample_on(change):
    one, two = OnlineEstimator({'variant': 'fuzzy'}), OnlineEstimator({'variant': 'fuzzy'})
    channels = EstimatorBatch([one])
    unknown_inputs = []
    for k in range(40):
        if k == 20:
            before = one.observer.state.values['z_tilde']
            one.configure(change)
            two.configure(change)
        stamp, y = 10**18 + k * MS, 0.1 * np.sin(0.1 * k)
        two.advance(stamp, y)
        unknown_inputs.append(channels.advance([0], [stamp], [y], [0.0])[1][0])
        assert unknown_inputs[-1] == two.observer.unknown_input
    assert np.any(before != one.observer.state.values['z_tilde'])
    assert_same_state(one, two)
