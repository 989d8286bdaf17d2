# SPDX-License-Identifier: Apache-2.0
"""A node, a replay and one that goes on from a snapshot do the same, bit for bit."""

from fhaosmo_ros.core import ConfigurationError, OnlineEstimator
from fhaosmo_ros.core.online.snapshots import Flag, pack, unpack
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

MS = 1_000_000
PERIODS = [MS, MS, MS, MS, 2 * MS, 0, -MS, 499 * MS, 501 * MS, -700 * MS]
VALUES = [0.0, 0.1, 0.1, 0.2, -0.3, float('nan'), float('inf'), 1e300]


def one_by_one(estimator, stamps, y, u):
    """Yield what an estimator shows after each sample, in the order of a `table`."""
    for stamp, sample, known in zip(stamps.tolist(), y.tolist(), u.tolist(), strict=True):
        for j, value in enumerate(known):
            estimator.set_input(value, j)
        e = estimator.update(stamp, sample)
        yield [*e.z, e.unknown_input, e.gamma, *e.innovation, int(e.status), e.open_levels]


def table(run):
    names = ('z', 'unknown_input', 'gamma', 'innovation', 'status', 'open_levels')
    return np.column_stack([getattr(run, name) for name in names])


def events_of(estimator):
    return [event._replace(sample=0) for event in estimator.events.taken()]


LEVANT = {
    'structure': 'levant', 'scheme': 'predict_correct', 'correction_period': 2e-3,
    'lambda': [8.0, 20.0, 30.0, 16.0], 'fuzzy_widths': [0.1], 'noise_size': 1e-3,
}  # fmt: skip
SECOND = {'order': 2, 'phi': ['0', '8*u - 3*z2 - 5*sin(z1)']}
DELAYED = SECOND | {'measurement_delay': 0.04, 'variant': 'sign'}
CASES = {
    'cascade': {'phi': ['0', '0', 'u - z3']},
    'explicit': {'scheme': 'explicit', 'variant': 'sign_adaptive'},
    'scheduled': {'noise_size': 1e-3}, 'levant': LEVANT,
    'events': LEVANT | {'event_threshold': 0.05},
    'changes': LEVANT | {'event_threshold': 0.05, 'event_change_time': 0.3},
    'two inputs': {'order': 2, 'phi': ['0', 'a - b'], 'inputs': ['a', 'b']},
    'delay': DELAYED, 'predicted': DELAYED | {'predict_to_now': True},
    'no input': DELAYED | {'phi': ['0', '-z2'], 'predict_to_now': True},
    'input as late': DELAYED | {'input_delay': 0.04, 'predict_to_now': True},
    'self-tuning': SECOND | {'gains': 'self_tuning', 'event_deviations': 3.0},
}  # fmt: skip


def disturbed():
    """Samples at 500 Hz with all that a live run has: jitter, spikes, gaps, a stamp ahead."""
    rng = np.random.default_rng(4)
    count = 1500
    stamps = 10**18 + 2 * MS * np.arange(count) + rng.integers(-300_000, 300_000, count)
    stamps[400:] += 30 * MS
    stamps[600] += 50 * MS
    stamps[1000:] += 10**9
    y = 0.2 + 0.1 * np.sin(stamps % 10**10 * 3e-9) + 1e-4 * rng.standard_normal(count)
    y += 0.05 * np.maximum((stamps - stamps[650]) * 1e-9, 0.0) ** 2  # d steps up
    y[200], y[300] = 9.0, np.nan
    return stamps, y, 0.3 + 0.1 * rng.standard_normal((count, 2))


@pytest.mark.parametrize('case', CASES)
def test_one_by_one_at_once_and_resumed_are_the_same(case):
    parameters = CASES[case] | {'spike_gate': 1.0, 'max_gap': 0.5}
    stamps, y, u = disturbed()
    one, many, resumed = (OnlineEstimator(parameters) for _ in range(3))
    u = u[:, : len(one.inputs)]
    found = table(many.run(stamps, y, u))
    assert many.counters.rejected_spikes >= 1
    assert many.counters.restarts == 1
    for k, now in enumerate(one_by_one(one, stamps, y, u)):
        np.testing.assert_array_equal(now, found[k])
        if k == 699:
            labels, vector = pack(Flag.CHANGED, one.state_dict())
            snapshot = unpack(vector.tolist(), labels)
            assert (snapshot.stamp, snapshot.flags) == (one.latest, Flag.CHANGED)
            resumed.run(stamps[:50], y[:50])  # whatever it was before
            resumed.load_state_dict(snapshot.values)
            resumed.events.taken()
            assert (resumed.inputs, resumed.stamp) == (one.inputs, one.stamp)
        one.set_input(-3.0)  # not yet: the next sample has another one
    rest = table(resumed.run(stamps[700:], y[700:], u[700:]))
    np.testing.assert_array_equal(rest, found[700:])
    events, of_one, of_resumed = map(events_of, (many, one, resumed))
    assert bool(events) == many.events.on
    assert of_one == events
    assert of_resumed == [e for e in events if e.stamp > stamps[699]]


SETTINGS = [
    {}, {'spike_gate': 0.05}, {'stuck_time': 2.5e-3}, {'epsilon': 0.02, 'divergence_time': 3e-3},
    {'scheme': 'explicit'}, {'event_threshold': 0.5, 'event_duration': 0.0},
    {'event_threshold': 0.5, 'event_duration': 2e-3, 'event_change_time': 0.03},
]  # fmt: skip


periods_and_values = st.tuples(st.sampled_from(PERIODS), st.sampled_from(VALUES))


@given(
    st.lists(periods_and_values, min_size=1, max_size=60), st.sampled_from(SETTINGS),
    st.sampled_from(['source_stamp', 'clock', 'nominal']), st.sampled_from([1, 3, 7, 100]),
)  # fmt: skip
def test_gaps_jumps_and_bad_samples_are_the_same(samples, settings, sampling, size):
    stamps = 10**18 + np.cumsum([period for period, _ in samples])
    y = np.array([value for _, value in samples])
    u = np.where(np.arange(len(y)) % 3 == 2, np.nan, 0.1 * np.arange(len(y)))
    parameters = {'sampling': sampling, 'phi': ['0', '0', 'u - z3']} | settings
    one, other = OnlineEstimator(parameters), OnlineEstimator(parameters)
    rows = list(one_by_one(one, stamps, y, u[:, np.newaxis]))
    parts = [
        table(other.run(stamps[k : k + size], y[k : k + size], u[k : k + size]))
        for k in range(0, len(y), size)
    ]
    np.testing.assert_array_equal(np.concatenate(parts), rows)  # bit for bit
    assert events_of(one) == events_of(other)
    for name in ('counters', 'period', 'stamp', 'inputs'):
        assert getattr(one, name) == getattr(other, name)
    np.testing.assert_equal(other.state_dict(), one.state_dict())


def fed(count, **parameters):
    """Return an estimator that has taken samples with jitter."""
    estimator, rng = OnlineEstimator(parameters), np.random.default_rng(3)
    k = np.arange(count)
    stamps = 1_700_000_000_123_456_789 + k * MS + rng.integers(-200_000, 200_000, count)
    estimator.run(stamps, 0.2 + 0.1 * np.sin(3e-3 * k))
    return estimator


@pytest.mark.parametrize('integer', [0, -1, 2**63 - 1, -(2**63), 1_700_000_000_123_456_789])
def test_labels_name_what_stands_there_and_integers_come_back_exactly(integer):
    estimator = fed(700)
    own, events = estimator.policy.memory, vars(estimator.events.memory)
    names = ['version', *estimator.observer.structure.state_dict(), *own, *events]
    assert sorted(estimator.state_dict()) == sorted(names)  # none twice
    times = ('stamp', 'latest', 'now', 'held_stamp', 'seen', 'tick', 'placed', 'event_since')
    state = estimator.state_dict() | dict.fromkeys(times, integer)
    labels, vector = pack(Flag.RESET, state)
    assert labels[:3] == ['version', 'z_hat:4', 'z_tilde:4']
    assert {'latest:integer', 'covariance:4x4'} <= {*labels}
    snapshot, other = unpack(vector, labels), OnlineEstimator()
    assert (snapshot.stamp, snapshot.flags) == (integer, Flag.RESET)
    other.load_state_dict(snapshot.values)
    np.testing.assert_equal(other.state_dict(), state)


LATE = {'gains': 'fixed', 'measurement_delay': 0.1, 'phi': ['u', '0', '0']}


@pytest.mark.parametrize(('name', 'number'), [
    ('past_place', -1), ('past_place', 512), ('past_count', 513), ('event', 6), ('intervals', 33),
    ('repeated', 1.5), ('lost', 2), ('latest', 2**63), ('latest', 0.5), ('latest', 'x'),
    ('mean_interval', -1.0), ('mean_interval', np.nan), ('held_y', np.inf), ('z_hat', np.zeros(3)),
    ('z_hat', np.full(4, np.nan)), ('past_pieces', np.full((512, 2), np.inf)), ('u', np.zeros(2)),
    ('past_latest', None), ('version', 2), ('spread', 0.0),
])  # fmt: skip
def test_a_number_that_can_not_be_is_refused_and_changes_nothing(name, number):
    estimator, good = fed(50, **LATE), fed(100, **LATE).state_dict()
    before = estimator.state_dict()
    for values in (good | {name: number}, {k: v for k, v in good.items() if k != name}):
        with pytest.raises(ConfigurationError, match='snapshot'):
            estimator.load_state_dict(values)
        np.testing.assert_equal(estimator.state_dict(), before)


def test_snapshot_of_other_entries_or_sizes_is_refused():
    labels, vector = pack(Flag(0), OnlineEstimator().state_dict())
    with pytest.raises(ConfigurationError, match='whole arrays'):
        unpack(np.zeros(8), labels)
    with pytest.raises(ConfigurationError, match='entries'):
        unpack(vector, [*labels[:-1], labels[0]])
    for names in ([], ['flags'], ['version'], ['y', 'z']):
        with pytest.raises(ConfigurationError, match='version'):
            unpack(np.full(len(names), 8.0), names)
    for name in ('y', 'w:9999999', 'w:2', 'w:n', 'w:-1x9', 'w:integer', 'w:1e3', 'w:9' * 99):
        with pytest.raises(ConfigurationError, match='snapshot'):
            unpack([*vector, 0.0], [*labels, name])
    for number in np.nan, np.inf, -(2.0**33):
        with pytest.raises(ConfigurationError, match=r"snapshot: (expected|'flags')"):
            unpack([*vector[:-2], number, 0.0], labels)
    two = OnlineEstimator({'order': 2, 'phi': ['0', 'a - b'], 'inputs': ['a', 'b']}).state_dict()
    for other, said in (
        ({'order': 2, 'phi': ['0', 'u']}, 'expected finite numbers of shape'),
        (LATE, 'measurement_delay'),
    ):
        with pytest.raises(ConfigurationError, match=said):
            OnlineEstimator(other).load_state_dict(two)
