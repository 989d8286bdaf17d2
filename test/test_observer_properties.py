# SPDX-License-Identifier: Apache-2.0
"""What holds for every observer: splits, snapshots, symmetry, what an estimate is."""

from fhaosmo_ros.core import Observer
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from observer_cases import (
    any_law,
    assert_same_state,
    concatenated,
    laws,
    remembered,
    samples,
    SMALL,
    state_of,
)
import pytest


@given(any_law, st.integers(0, 200), st.integers(0, 200))
def test_split_run_equals_whole_run(law, a, b):
    t, y, u = samples()
    whole, split = Observer(SMALL | law), Observer(SMALL | law)
    expected = whole.run(t, y, u)
    cuts = [slice(0, min(a, b)), slice(min(a, b), max(a, b)), slice(max(a, b), None)]
    parts = concatenated(split.run(t[cut], y[cut], u[cut]) for cut in cuts)
    for name, got, wanted in zip(expected._fields, parts, expected, strict=True):
        np.testing.assert_array_equal(got, wanted, err_msg=name)
    assert_same_state(state_of(split), state_of(whole))


@laws
def test_steps_equal_a_run(law):
    t, y, u = samples()
    expected = Observer(SMALL | law).run(t, y, u)
    observer = Observer(SMALL | law)
    latest = t[0]
    for k in range(len(t)):
        if observer.started:
            estimate = observer.step(y[k], t[k] - latest, u[k])
        else:
            estimate = observer.start(y[k])
        latest = max(latest, t[k])
        np.testing.assert_array_equal(estimate.z, expected.z[k])
        assert estimate.unknown_input == expected.unknown_input[k]
        assert estimate.gamma == expected.gamma[k]
        np.testing.assert_array_equal(estimate.innovation, expected.innovation[k])
        assert estimate.status == expected.status[k]
        assert estimate.open_levels == expected.open_levels[k]


def test_snapshot_is_a_copy():
    observer = Observer(SMALL)
    observer.run(*samples())
    snapshot = state_of(observer)
    snapshot['z_hat'][:] = 7.0
    assert not np.any(remembered(observer, 'z_hat') == 7.0)
    estimate = observer.step(0.1, 1e-3, 0.0)
    z, innovation = estimate.z.copy(), estimate.innovation.copy()
    observer.step(5.0, 1e-3, 0.0)
    np.testing.assert_array_equal(estimate.z, z)
    np.testing.assert_array_equal(estimate.innovation, innovation)


def test_snapshot_of_another_variant_gives_a_power_that_fits():
    adaptive = Observer(SMALL | {'variant': 'fuzzy_adaptive', 'gamma_initial': 0.7})
    sign = Observer(SMALL | {'variant': 'sign'})
    sign.structure.load_state_dict(state_of(adaptive))
    assert remembered(sign, 'gamma') == 0.5
    narrow = Observer(SMALL | {'variant': 'fuzzy_adaptive', 'gamma_max': 0.6})
    narrow.structure.load_state_dict(state_of(adaptive))
    assert remembered(narrow, 'gamma') == 0.6


def test_reset_equals_a_new_observer():
    observer = Observer(SMALL)
    observer.run(*samples())
    observer.reset()
    assert_same_state(state_of(observer), state_of(Observer(SMALL)))
    assert not observer.started


@given(any_law, st.integers(1, 250))
def test_every_kth_row_is_the_row_of_the_full_run(law, every):
    t, y, u = samples()
    full = Observer(SMALL | law).run(t, y, u)
    observer = Observer(SMALL | law)
    thin = observer.run(t, y, u, every=every)
    rows = slice(every - 1, None, every)
    for name in set(full._fields) - {'status'}:
        np.testing.assert_array_equal(getattr(thin, name), getattr(full, name)[rows])
    groups = full.status[: len(t) // every * every].reshape(-1, every)
    np.testing.assert_array_equal(thin.status, np.bitwise_or.reduce(groups, axis=1))


# Symmetry


@laws
@pytest.mark.parametrize('phi', [['0', '0', '-z3'], ['sin(z1)', 'z2**3 - z1', 'tanh(z3) + u']])
def test_odd_model_gives_an_odd_estimate(law, phi):
    t, y, u = samples()
    p = {'order': 3, 'phi': phi, 'lambda': 3.0, 'alpha': 4.0, 'gamma_rate': 0.5} | law
    one, other = Observer(p).run(t, y, u), Observer(p).run(t, -y, -u)
    for name in ('z', 'unknown_input', 'innovation', 'z_hat', 'z_tilde'):
        np.testing.assert_array_equal(getattr(other, name), -getattr(one, name), err_msg=name)
    np.testing.assert_array_equal(other.gamma, one.gamma)
    np.testing.assert_array_equal(other.open_levels, one.open_levels)


# Estimates


def test_one_value_serves_every_level():
    t, y, u = samples()
    one = Observer(SMALL | {'lambda': 4, 'alpha': [5], 'fuzzy_widths': 0.03})
    many = Observer(SMALL | {'lambda': [4.0] * 3, 'alpha': [5.0] * 3, 'fuzzy_widths': [0.03] * 3})
    for got, wanted in zip(one.run(t, y, u), many.run(t, y, u), strict=True):
        np.testing.assert_array_equal(got, wanted)


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
