# SPDX-License-Identifier: Apache-2.0
"""What holds for every observer: splits, snapshots, times, what an estimate is."""

from fhaosmo_ros.core import ConfigurationError, Observer
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from observer_cases import any_law, assert_same_state, laws, samples, SMALL, state_of
import pytest


@given(any_law, st.integers(0, 200), st.integers(0, 200))
def test_split_run_and_steps_equal_a_whole_run_and_a_reset_forgets_it(law, a, b):
    """Each estimate is a copy."""
    t, y, u = samples()
    whole, split, steps = (Observer(SMALL | law) for _ in range(3))
    expected = whole.run(t, y, u)
    parts = (np.split(column, sorted([a, b])) for column in (t, y, u))
    runs = [split.run(*part) for part in zip(*parts, strict=True)]
    parts = [np.concatenate(columns) for columns in zip(*runs, strict=True)]
    for name, got, wanted in zip(expected._fields, parts, expected, strict=True):
        np.testing.assert_array_equal(got, wanted, err_msg=name)
    assert_same_state(state_of(split), state_of(whole))
    found = []
    for h, y_k, u_k in zip(np.diff(t, prepend=0.0), y, u, strict=True):
        found.append(steps.step(y_k, h, u_k) if steps.started else steps.start(y_k))
    for name in ('z', 'unknown_input', 'gamma', 'innovation', 'status', 'open_levels'):
        column = [getattr(estimate, name) for estimate in found]
        np.testing.assert_array_equal(column, getattr(expected, name))
    whole.reset()
    assert_same_state(state_of(whole), state_of(Observer(SMALL | law)))


def test_snapshot_of_another_variant_gives_a_power_that_fits():
    adaptive = Observer(SMALL | {'variant': 'fuzzy_adaptive', 'gamma_initial': 0.7})
    bound = {'gamma_initial': 0.9, 'gamma_min': 0.8}
    for other, power in ({'variant': 'sign'}, 0.5), (bound, 0.8):
        observer = Observer(SMALL | {'variant': 'fuzzy_adaptive'} | other)
        observer.structure.load_state_dict(state_of(adaptive))
        assert state_of(observer)['gamma'] == power


def test_estimates_are_the_internal_or_the_filtered_states():
    t, y, u = samples()
    for extra in (True, False):
        p = SMALL | {'unknown_input': extra}
        internal = Observer(p | {'estimate_from': 'internal'}).run(t, y, u)
        filtered = Observer(p | {'estimate_from': 'filtered'}).run(t, y, u)
        hat, tilde = internal.z_hat, internal.z_tilde
        np.testing.assert_array_equal(internal.z, np.stack([hat[:, 0], tilde[:, 0]], axis=1))
        np.testing.assert_array_equal(internal.unknown_input, tilde[:, 1])
        np.testing.assert_array_equal(filtered.z, hat[:, :2])
        # Without its own level the unknown input is theta, which has no filtered version.
        d = hat[:, 2] if extra else tilde[:, 1]
        np.testing.assert_array_equal(filtered.unknown_input, d)


def test_runs_that_cannot_be_are_refused_and_an_empty_one_changes_nothing():
    observer = Observer(SMALL)
    assert observer.run([], [], 0.0).z.shape == (0, 2)
    observer.run([0.0, 0.001], [0.1, 0.1], 0.0)
    before = state_of(observer)
    for bad in (0.001, -1.0, np.nan, np.inf, -np.inf):
        for t in ([0.002, bad, 0.003], [bad, 0.002, 0.003]):
            with pytest.raises(ConfigurationError, match=r'increase, got t\[[01]\] = '):
                observer.run(t, [0.1, 0.2, 0.3], 0.0)
    for arguments in ([0.0],), ([[0.0, 1.0]],), ([0.0, 1.0], [0.0] * 3):
        with pytest.raises(ConfigurationError, match='expected'):
            observer.run([2.0, 3.0], *arguments)
    assert_same_state(state_of(observer), before)


@laws
@pytest.mark.parametrize('kind', [np.int64, np.uint64])
def test_nanoseconds_are_seconds_and_stay_exact_at_a_large_epoch(law, kind):
    steps = np.cumsum(np.random.default_rng(2).integers(500_000, 2_000_000, 300))
    y, stamps = np.sin(3e-9 * steps), steps.astype(kind) + kind(1_799_999_999_999_999_999)
    near, observer = Observer(SMALL | law).run(steps, y, 0.0), Observer(SMALL | law)
    far = [observer.run(stamps[part], y[part], 0.0).z for part in (np.s_[:150], np.s_[150:])]
    np.testing.assert_array_equal(np.concatenate(far), near.z)
    np.testing.assert_array_equal(near.t, steps)
    # Rounding of t only; sign's chatter would amplify it, explicitly.
    tolerance = 1e-6 if law['scheme'] == 'explicit' else 1e-9
    seconds = Observer(SMALL | law).run(steps * 1e-9, y, 0.0)
    np.testing.assert_allclose(seconds.z, near.z, atol=tolerance)
