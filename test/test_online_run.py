# SPDX-License-Identifier: Apache-2.0
"""The batch path of a replay is the live path, bit for bit, whatever the samples."""

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

MS = 1_000_000
PERIODS = [MS, MS, MS, MS, 2 * MS, 0, -MS, 499 * MS, 501 * MS, -700 * MS]
VALUES = [0.0, 0.1, 0.1, 0.2, -0.3, float('nan'), float('inf'), 1e300]


def live(parameters, stamps, y, u):
    estimator = OnlineEstimator(parameters)
    rows, words = [], []
    for stamp, sample, known in zip(stamps.tolist(), y.tolist(), u.tolist(), strict=True):
        estimator.set_input(known)
        e = estimator.update(stamp, sample)
        rows.append([*e.z, e.unknown_input, e.gamma, *e.innovation])
        words.append((int(e.status), e.open_levels))
    return estimator, np.array(rows), np.array(words)


def batch(parameters, stamps, y, u, size):
    estimator = OnlineEstimator(parameters)
    rows, words = [], []
    for k in range(0, len(y), size):
        p = estimator.run(stamps[k : k + size], y[k : k + size], u[k : k + size])
        rows.append(np.column_stack([p.z, p.unknown_input, p.gamma, p.innovation]))
        words.append(np.column_stack([p.status, p.open_levels]))
    return estimator, np.concatenate(rows), np.concatenate(words)


def assert_same(parameters, stamps, y, u, size):
    one, rows, words = live(parameters, stamps, y, u)
    other, rows_, words_ = batch(parameters, stamps, y, u, size)
    np.testing.assert_array_equal(rows_, rows)  # bit for bit
    np.testing.assert_array_equal(words_, words)
    assert other.counters == one.counters
    assert (other.period, other.jitter) == (one.period, one.jitter)
    assert other.stamp == one.stamp
    last = one.update(int(stamps[-1]) + 3 * MS, 0.05)
    np.testing.assert_array_equal(other.update(int(stamps[-1]) + 3 * MS, 0.05).z, last.z)
    if one.estimate is not None:
        np.testing.assert_array_equal(other.estimate.z, one.estimate.z)
        np.testing.assert_array_equal(other.estimate.innovation, one.estimate.innovation)


@pytest.mark.parametrize('variant', ['sign', 'fuzzy', 'fuzzy_adaptive'])
@pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
def test_a_long_clean_run_is_the_same(variant, scheme):
    rng = np.random.default_rng(1)
    stamps = 10**18 + np.cumsum(MS + rng.integers(-20_000, 20_000, 3000))
    y = 0.2 + 0.1 * np.sin(np.arange(3000) * 1e-3)
    parameters = {'variant': variant, 'scheme': scheme, 'phi': ['0', '0', 'u - z3']}
    u = np.where(np.arange(3000) > 1000, 0.3, 0.0)
    assert_same(parameters, stamps, y, u, 1024)


SETTINGS = [
    {},
    {'spike_gate': 0.05},
    {'stuck_time': 2.5e-3},
    {'epsilon': 0.02, 'divergence_time': 3e-3},
    {'divergence_limit': 10.0, 'scheme': 'explicit'},
]


@given(
    st.lists(
        st.tuples(st.sampled_from(PERIODS), st.sampled_from(VALUES)), min_size=1, max_size=60
    ),
    st.sampled_from(['source_stamp', 'clock', 'nominal']),
    st.sampled_from(SETTINGS),
    st.sampled_from([1, 3, 7, 100]),
)
def test_gaps_jumps_and_bad_samples_are_the_same(samples, sampling, settings, size):
    stamps = 10**18 + np.cumsum([period for period, _ in samples])
    y = np.array([value for _, value in samples])
    u = np.where(np.arange(len(y)) % 5 == 4, np.nan, 0.1)
    parameters = {'sampling': sampling, 'phi': ['0', '0', 'u - z3']} | settings
    assert_same(parameters, stamps, y, u, size)
