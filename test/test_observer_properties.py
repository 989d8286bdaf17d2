# SPDX-License-Identifier: Apache-2.0
"""What holds for every observer and every input: splits, snapshots, symmetry, bad data."""

from fhaosmo_ros.core import ConfigurationError, Observer, Status
from fhaosmo_ros.core.layout import GAMMA, HAT, PENDING, TILDE, Y
from fhaosmo_ros.core.parameters import OBSERVER_PARAMETERS
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

# Every number that a test relies on; the defaults may change.
SMALL = {'order': 2, 'phi': ['0', '-z2*z2*z1 + u'], 'lambda': 3.0, 'alpha': 4.0}
SMALL |= {'epsilon': 0.025, 'fuzzy_widths': [0.02], 'unknown_input': True}
SMALL |= {'gamma_initial': 0.5, 'gamma_min': 0.3, 'gamma_max': 0.8, 'gamma_rate': 0.004}
SMALL |= {'gamma_dead_zone': 0.0, 'gamma_leakage': 0.0, 'start_from_measurement': True}
LAWS = [
    {'scheme': scheme, 'variant': variant}
    for scheme in ('explicit', 'implicit')
    for variant in ('sign', 'fuzzy', 'fuzzy_adaptive')
]
laws = pytest.mark.parametrize('law', LAWS, ids=lambda law: '-'.join(law.values()))
any_law = st.sampled_from(LAWS)


def samples(count=200, seed=1):
    """Return t, y, u with NaNs, duplicate and backward stamps, and a first sample that is bad."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.5e-3, 2e-3, count))
    y = np.sin(3.0 * t) + 1e-3 * rng.standard_normal(count)
    u = rng.uniform(-1.0, 1.0, count)
    t[60], t[61], t[90] = t[59], t[58], t[70]
    y[[0, 1, 30, 31, 100]] = np.nan
    y[120], u[140] = np.inf, np.nan
    return t, y, u


def concatenated(runs):
    return [np.concatenate(parts) for parts in zip(*runs, strict=True)]


def assert_same_state(one, other):
    for field in ('levels', 'memory'):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field))
    np.testing.assert_equal(one.t, other.t)


# A run can be cut anywhere


@given(any_law, st.integers(0, 200), st.integers(0, 200))
def test_split_run_equals_whole_run(law, a, b):
    t, y, u = samples()
    whole, split = Observer(SMALL | law), Observer(SMALL | law)
    expected = whole.run(t, y, u)
    cuts = [slice(0, min(a, b)), slice(min(a, b), max(a, b)), slice(max(a, b), None)]
    parts = concatenated(split.run(t[cut], y[cut], u[cut]) for cut in cuts)
    for name, got, wanted in zip(expected._fields, parts, expected, strict=True):
        np.testing.assert_array_equal(got, wanted, err_msg=name)
    assert_same_state(split.state, whole.state)


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


@laws
def test_snapshot_brings_an_observer_back(law):
    t, y, u = samples()
    observer, other = Observer(SMALL | law), Observer(SMALL | law)
    observer.run(t[:100], y[:100], u[:100])
    snapshot = observer.state
    first = observer.run(t[100:], y[100:], u[100:])
    observer.restore(snapshot)
    other.restore(snapshot)
    for again in (observer, other):
        for got, wanted in zip(again.run(t[100:], y[100:], u[100:]), first, strict=True):
            np.testing.assert_array_equal(got, wanted)


def test_snapshot_is_a_copy():
    observer = Observer(SMALL)
    observer.run(*samples())
    snapshot = observer.state
    snapshot.levels[:] = 7.0
    snapshot.memory[:] = 7.0
    assert not np.any(observer.state.levels == 7.0)
    assert not np.any(observer.state.memory == 7.0)
    estimate = observer.step(0.1, 1e-3)
    z, innovation = estimate.z.copy(), estimate.innovation.copy()
    observer.step(5.0, 1e-3)
    np.testing.assert_array_equal(estimate.z, z)
    np.testing.assert_array_equal(estimate.innovation, innovation)


def test_snapshot_of_another_size_is_refused():
    observer = Observer(SMALL)
    before = observer.state
    with pytest.raises(ConfigurationError, match='expected 3 levels, got 4'):
        observer.restore(Observer().state)
    assert_same_state(observer.state, before)


def test_snapshot_of_another_variant_gives_a_power_that_fits():
    adaptive = Observer(SMALL | {'variant': 'fuzzy_adaptive', 'gamma_initial': 0.7})
    sign = Observer(SMALL | {'variant': 'sign'})
    sign.restore(adaptive.state)
    assert sign.state.memory[GAMMA] == 0.5
    narrow = Observer(SMALL | {'variant': 'fuzzy_adaptive', 'gamma_max': 0.6})
    narrow.restore(adaptive.state)
    assert narrow.state.memory[GAMMA] == 0.6


def test_reset_equals_a_new_observer():
    observer = Observer(SMALL)
    observer.run(*samples())
    observer.reset()
    assert_same_state(observer.state, Observer(SMALL).state)
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


# Bad data


USABLE = 1e-8 * np.finfo(float).max
"""Beyond this, numbers count as infinite."""
wild = st.floats() | st.sampled_from([0.0, 1e-320, 1e-300, 1e150, 1e300, 1.797e308, -1.797e308])
wild_sample = st.tuples(wild, st.floats(1e-6, 0.1) | wild, st.floats(-1.0, 1.0) | wild)


@given(any_law, st.lists(wild_sample, max_size=8))
def test_state_stays_finite_and_rejected_samples_leave_it_alone(law, inputs):
    observer = Observer(SMALL | law)
    observer.start(0.3)
    for y, dt, u in inputs:
        before = observer.state
        estimate = observer.step(y, dt, u)
        after = observer.state
        assert np.all(np.isfinite(after.levels))
        assert np.all(np.isfinite(after.memory))
        assert np.all(np.isfinite(estimate.z))
        assert np.all(np.isfinite(estimate.innovation))
        assert np.isfinite(estimate.unknown_input)
        assert 1 <= estimate.open_levels <= 3
        status = estimate.status
        assert bool(status & Status.REJECTED_PERIOD) == (not 0.0 < dt < USABLE)
        assert bool(status & Status.REJECTED_INPUT) == (not np.isfinite(u))
        assert bool(status & Status.REJECTED_MEASUREMENT) == (not abs(y) < USABLE)
        if status.rejected:
            np.testing.assert_array_equal(after.levels, before.levels)
            assert after.memory[GAMMA] == before.memory[GAMMA]
        else:
            assert after.memory[Y] == y
            assert after.memory[PENDING] == 0.0


@given(any_law, st.lists(wild_sample, max_size=8))
def test_observer_recovers_from_wild_data(law, inputs):
    observer = Observer(SMALL | law)
    observer.start(0.3)
    for y, dt, u in inputs:
        levels = observer.state.levels
        # A wild sample that is accepted is the truth, and the state goes where it leads: what is
        # tested here is that one that is not accepted leaves no trap behind.
        if not observer.step(y, dt, u).status.rejected:
            observer.restore(type(observer.state)(levels, observer.state.memory))
    observer.step(0.3, 1e-3)
    assert not observer.step(0.3, 1e-3).status.rejected


@pytest.mark.parametrize('spike', [1e60, 1e150, 1e307, -1e307])
@laws
def test_spike_that_the_model_cannot_digest_is_rejected_once(law, spike):
    observer = Observer({'order': 1, 'phi': ['-z1**7'], 'unknown_input': False} | law)
    observer.start(0.1)
    words = [observer.step(y, 1e-3).status for y in (0.1, spike, 0.1, 0.1, 0.1)]
    assert sum(word.rejected for word in words) == 1
    assert abs(observer.state.levels[HAT, 0]) < 1.0


@laws
def test_time_of_a_rejected_sample_is_carried_over(law):
    one, other = Observer(SMALL | law), Observer(SMALL | law)
    for observer in (one, other):
        observer.start(0.3)
        observer.step(0.31, 1e-3)
    assert one.step(np.nan, 1e-3).status == Status.REJECTED_MEASUREMENT
    assert one.step(-np.inf, 2e-3).status == Status.REJECTED_MEASUREMENT
    assert one.step(0.35, 1e-3, np.nan).status == Status.REJECTED_INPUT
    assert one.step(0.35, -1.0).status == Status.REJECTED_PERIOD
    assert one.step(np.nan, np.nan, np.inf).status == (
        Status.REJECTED_MEASUREMENT | Status.REJECTED_PERIOD | Status.REJECTED_INPUT
    )
    np.testing.assert_allclose(one.state.memory[PENDING], 4e-3)
    one.step(0.4, 2e-3)
    other.step(0.4, 1e-3 + 2e-3 + 1e-3 + 2e-3)
    np.testing.assert_allclose(one.state.levels, other.state.levels, rtol=1e-12)
    assert one.state.memory[PENDING] == 0.0


@pytest.mark.parametrize('dt', [0.0, -0.0, -1e-3, np.nan, np.inf, -np.inf])
def test_period_that_is_not_positive_is_rejected(dt):
    observer = Observer(SMALL)
    observer.start(0.3)
    before = observer.state
    estimate = observer.step(0.3, dt)
    assert estimate.status == Status.REJECTED_PERIOD
    assert estimate.status.rejected
    assert_same_state(observer.state, before)


def test_samples_before_the_first_good_one():
    observer = Observer(SMALL | {'initial_estimate': [0.5, 0.1, 0.0]})
    assert observer.start(np.nan).status == Status.REJECTED_MEASUREMENT
    assert observer.step(np.inf, 1e-3).status == Status.REJECTED_MEASUREMENT
    assert not observer.started
    result = observer.run([0.0, 0.1, 0.2], [np.nan, 2.0, 2.0])
    np.testing.assert_array_equal(result.z[:2, 0], [0.5, 2.0])  # not before it has come
    assert result.status[0] == Status.REJECTED_MEASUREMENT
    assert not result.status[1] & Status.REJECTED_MEASUREMENT
    assert observer.started


# Stamps in a run


def test_backward_and_duplicate_stamps_are_rejected():
    t = np.array([0.0, 1.0, 1.0, 0.5, 2.0, 1.5, 3.0]) * 1e-3
    result = Observer(SMALL).run(t, np.linspace(0.1, 0.2, 7))
    late = (result.status & Status.REJECTED_PERIOD) != 0
    np.testing.assert_array_equal(late, [0, 0, 1, 1, 0, 1, 0])
    good = Observer(SMALL).run(t[~late], np.linspace(0.1, 0.2, 7)[~late])
    np.testing.assert_array_equal(result.z[~late], good.z)


@pytest.mark.parametrize('stamp', [np.nan, np.inf, -np.inf])
def test_stamp_that_is_not_finite_spoils_its_own_sample_only(stamp):
    t = np.arange(6) * 1e-3
    bad = t.copy()
    bad[2] = stamp
    y = np.linspace(0.1, 0.2, 6)
    result = Observer(SMALL).run(bad, y)
    late = (result.status & Status.REJECTED_PERIOD) != 0
    np.testing.assert_array_equal(late, [0, 0, 1, 0, 0, 0])
    good = Observer(SMALL).run(np.delete(t, 2), np.delete(y, 2))
    np.testing.assert_array_equal(result.z[~late], good.z)


def test_stamp_of_a_sample_before_the_first_good_one_does_not_count():
    result = Observer(SMALL).run([5.0, 1.0, 1.001], [np.nan, 0.1, 0.1])
    assert not result.status[2] & Status.REJECTED_PERIOD


@laws
def test_nanoseconds_equal_seconds(law):
    nanoseconds = np.cumsum(np.random.default_rng(2).integers(500_000, 2_000_000, 300))
    y = np.sin(3e-9 * nanoseconds)
    one = Observer(SMALL | law).run(nanoseconds, y)
    other = Observer(SMALL | law).run(nanoseconds * 1e-9, y)
    # Rounding of t only; sign's chatter would amplify it, explicitly.
    tolerance = 1e-6 if law['scheme'] == 'explicit' else 1e-9
    np.testing.assert_allclose(one.z, other.z, atol=tolerance)
    np.testing.assert_array_equal(one.t, nanoseconds)


@laws
@pytest.mark.parametrize('epoch', [1_700_000_000_000_000_000, 1_799_999_999_999_999_999])
@pytest.mark.parametrize('kind', [np.int64, np.uint64])
def test_nanoseconds_stay_exact_at_a_large_epoch(law, epoch, kind):
    steps = np.cumsum(np.random.default_rng(2).integers(500_000, 2_000_000, 300))
    y = np.sin(3e-9 * steps)
    near = Observer(SMALL | law).run(steps, y)
    observer = Observer(SMALL | law)
    far = observer.run(steps[:150].astype(kind) + kind(epoch), y[:150])
    far_on = observer.run(steps[150:].astype(kind) + kind(epoch), y[150:])
    np.testing.assert_array_equal(np.concatenate([far.z, far_on.z]), near.z)


def test_arrays_that_do_not_fit_are_refused():
    observer = Observer(SMALL)
    before = observer.state
    for arguments in (
        ([0.0, 1.0], [0.0]),
        ([[0.0, 1.0]], [[0.0, 1.0]]),
        ([0.0, 1.0], [0.0, 1.0], [0.0, 1.0, 2.0]),
        ([0.0, 1.0], [0.0, 1.0], 0.0, 0),
    ):
        with pytest.raises(ConfigurationError, match='run: expected'):
            observer.run(*arguments)
    assert_same_state(observer.state, before)


def test_empty_run_changes_nothing():
    observer = Observer(SMALL)
    assert observer.run([], []).z.shape == (0, 2)
    observer.run(*samples())
    before = observer.state
    assert observer.run([], []).z.shape == (0, 2)
    assert_same_state(observer.state, before)


# Gates and gamma


@given(any_law, st.floats(1e-3, 10.0), st.integers(0, 5))
def test_gates_open_in_order(law, epsilon, seed):
    result = Observer(SMALL | law | {'epsilon': epsilon}).run(*samples(seed=seed))
    within = np.abs(result.innovation[:, :-1]) <= epsilon
    # Level i is open if every level before it is within epsilon: a first one always is.
    expected = 1 + np.logical_and.accumulate(within, axis=1).sum(axis=1)
    np.testing.assert_array_equal(result.open_levels, expected)


@pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
@pytest.mark.parametrize('bound', ['min', 'max'])
def test_saturated_gamma_is_flagged(scheme, bound):
    p = SMALL | {'variant': 'fuzzy_adaptive', 'scheme': scheme, 'gamma_initial': 0.5}
    p |= {'gamma_rate': 0.0, 'gamma_leakage': 100.0}
    observer = Observer(p)
    observer.start(0.0)
    assert not observer.step(0.1, 1e-3).status
    target = {'min': {'gamma_initial': 0.4, 'gamma_min': 0.4}}.get(
        bound, {'gamma_initial': 0.7, 'gamma_max': 0.7}
    )
    observer.configure(target)
    for _ in range(1000):
        estimate = observer.step(0.1, 1e-3)
    flag = {'min': Status.GAMMA_AT_MIN, 'max': Status.GAMMA_AT_MAX}[bound]
    np.testing.assert_allclose(estimate.gamma, target['gamma_initial'])
    observer.configure({'gamma_rate': 1e6})  # the gradient drives it to a bound, and beyond
    statuses = [observer.step(np.sin(0.1 * k), 1e-3).status for k in range(300)]
    assert any(status & flag for status in statuses)
    assert not any(status.rejected for status in statuses)


@given(st.floats(0.0, 1e6), st.floats(0.0, 1e3), st.integers(0, 9), st.floats(1e-5, 10.0))
def test_gamma_stays_within_its_bounds(rate, leakage, seed, dt):
    p = SMALL | {'gamma_rate': rate, 'gamma_leakage': leakage, 'variant': 'fuzzy_adaptive'}
    for scheme in ('explicit', 'implicit'):
        observer = Observer(p | {'scheme': scheme})
        observer.start(0.0)
        for y in np.random.default_rng(seed).uniform(-1.0, 1.0, 50):
            assert 0.3 <= observer.step(y, dt).gamma <= 0.8


@given(st.floats(0.0, 1e3), st.floats(1e-5, 10.0))
def test_leakage_never_overshoots(leakage, dt):
    p = SMALL | {'variant': 'fuzzy_adaptive', 'gamma_rate': 0.0, 'gamma_leakage': leakage}
    observer = Observer(p | {'gamma_initial': 0.7})
    observer.start(0.0)
    observer.configure({'gamma_initial': 0.4})
    gamma = [0.7] + [observer.step(0.0, dt).gamma for _ in range(20)]
    assert np.all(np.diff(gamma) <= 1e-15)
    assert gamma[-1] >= 0.4 - 1e-12


# Live changes


CHANGES = {
    'variant': ['sign', 'fuzzy', 'fuzzy_adaptive'],
    'scheme': ['explicit', 'implicit'],
    'lambda': [2.0, [3.0, 4.0, 5.0]],
    'alpha': [2, [3, 4, 5]],
    'epsilon': [1.0],
    'fuzzy_widths': [0.5, [0.1, 0.2], [0.1, 0.2, 0.3]],
    'fuzzy_shape': ['gaussian'],
    'fuzzy_normalise': [False],
    'gamma_initial': [0.6],
    'gamma_rate': [0.0, 1.0],
    'gamma_min': [0.4],
    'gamma_max': [0.6],
    'gamma_dead_zone': [0.1],
    'gamma_leakage': [0.1],
    'initial_estimate': [1.0, [1.0, 2.0, 3.0]],
    'initial_internal': [1.0, [1.0, 2.0, 3.0]],
    'start_from_measurement': [False],
    'estimate_from': ['filtered', 'internal'],
}


def test_every_live_parameter_is_tried():
    assert set(CHANGES) == {p.name for p in OBSERVER_PARAMETERS.values() if p.live}


@pytest.mark.parametrize(
    ('name', 'value'), [(name, value) for name, values in CHANGES.items() for value in values]
)
@laws
def test_live_change_does_not_move_the_state(law, name, value):
    t, y, u = samples()
    observer = Observer(SMALL | law)
    observer.run(t, y, u)
    before = observer.state
    observer.configure({name: value})
    after = observer.state
    np.testing.assert_array_equal(after.levels[: TILDE + 1], before.levels[: TILDE + 1])
    np.testing.assert_array_equal(after.memory[Y:], before.memory[Y:])
    # A fresh observer in the same state goes on in the same way: nothing else is remembered.
    fresh = Observer(observer.parameters)
    fresh.restore(after)
    for k in range(20):
        one, other = (o.step(0.01 * k, 1e-3) for o in (observer, fresh))
        assert not one.status.rejected
        np.testing.assert_array_equal(one.z, other.z)
        assert one.gamma == other.gamma
    expected = OBSERVER_PARAMETERS[name].coerce(value)
    assert observer.parameters[name] == expected


@pytest.mark.parametrize(
    ('changes', 'named'),
    [
        ({'lambda': -1.0}, 'lambda'),
        ({'lambda': [1.0, 2.0]}, 'lambda'),
        ({'alpha': [1.0, float('nan'), 2.0]}, 'alpha'),
        ({'fuzzy_widths': [0.1] * 4}, 'fuzzy_widths'),
        ({'gamma_min': 0.6}, 'gamma_initial'),
        ({'gamma_min': 0.9}, 'gamma_min'),
        ({'order': 3}, 'order'),
        ({'phi': ['0', '0']}, 'phi'),
        ({'unknown_input': False}, 'unknown_input'),
        ({'initial_estimate': [0.0, 0.0]}, 'initial_estimate'),
        ({'lamda': 1.0}, 'lamda'),
    ],
    ids=str,
)
def test_refused_change_changes_nothing(changes, named):
    observer = Observer(SMALL)
    observer.run(*samples())
    before, parameters = observer.state, observer.parameters
    with pytest.raises(ConfigurationError, match=f"'{named}'") as error:
        observer.configure({'epsilon': 0.7} | changes)
    assert '\n' not in str(error.value)
    assert observer.parameters == parameters
    assert_same_state(observer.state, before)


def test_unchanged_value_of_a_fixed_parameter_is_accepted():
    observer = Observer(SMALL)
    observer.configure({'order': 2, 'phi': list(SMALL['phi']), 'unknown_input': True})


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
