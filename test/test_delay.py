# SPDX-License-Identifier: Apache-2.0
"""A known delay of y: the inputs that acted then, the estimate's time, and the present."""

from fhaosmo_ros.core import Family, Observer, OnlineEstimator
from fhaosmo_ros.core.simulation.plant import respond
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

FIRST = 10**18
PERIOD, LATE = 2_000_000, 20
"""Nanoseconds, and periods by which y is late."""
COUNT = 1500
STAMPS = FIRST + PERIOD * np.arange(COUNT)
MOTOR = {
    'order': 2, 'phi': ['0', '8*u - 3*z2 - 5*sin(z1)'], 'structure': 'levant', 'variant': 'sign',
    'scheme': 'predict_correct', 'lambda': [5.5, 16.0, 22.0],
}  # fmt: skip
DELAYED = MOTOR | {'measurement_delay': LATE * PERIOD * 1e-9}


def voltage():
    """u of the interval that ends at each sample; constant until the delay is over."""
    t = (STAMPS - STAMPS[2 * LATE]) * 1e-9
    return 0.3 + np.sin(40.0 * np.maximum(t, 0.0))


def truth(u):
    t = (STAMPS - STAMPS[0]) * 1e-9
    return respond(Observer(MOTOR).model, [0.1, 0.0], t, [0.7, 0.7], 100.0, u, 1e-3)


def late(y):
    return np.concatenate([np.full(LATE, np.nan), y[:-LATE]])


@pytest.mark.parametrize('inputs_too', [False, True])
@pytest.mark.parametrize('law', [
    {'scheme': 'predict_correct'}, {'scheme': 'implicit'},
    {'scheme': 'explicit', 'structure': 'cascade'},
])  # fmt: skip
def test_late_samples_give_the_estimates_of_punctual_ones(law, inputs_too):
    u, delay = voltage(), DELAYED['measurement_delay']
    y = truth(u)[0][:, 0]
    punctual = OnlineEstimator(MOTOR | law).run(STAMPS, y, u)
    if inputs_too:  # then all is as late
        delayed = OnlineEstimator(DELAYED | law | {'input_delay': delay}).run(STAMPS, y, u)
        now, then = slice(None), slice(None)
        np.testing.assert_array_equal(delayed.t, STAMPS - LATE * PERIOD)
    else:
        delayed = OnlineEstimator(DELAYED | law).run(STAMPS, late(y), u)
        now, then = slice(LATE, None), slice(-LATE)
        np.testing.assert_array_equal(delayed.t[now], STAMPS[then])
    np.testing.assert_array_equal(delayed.z[now], punctual.z[then])
    np.testing.assert_array_equal(delayed.unknown_input[now], punctual.unknown_input[then])


@pytest.mark.parametrize('estimate_from', ['internal', 'filtered'])
@pytest.mark.parametrize('share', [0.0, 0.5, 1.0], ids='input late by {} of the delay'.format)
def test_prediction_ends_at_the_present_state(share, estimate_from):
    full = DELAYED['measurement_delay']
    parameters = DELAYED | {'input_delay': share * full, 'estimate_from': estimate_from}
    u = np.repeat(voltage()[::50], 50)  # constant since long enough at the end
    z, d = truth(u)
    shown = np.roll(u, round(share * LATE))
    then = OnlineEstimator(parameters).run(STAMPS, late(z[:, 0]), shown)
    now = OnlineEstimator(parameters | {'predict_to_now': True}).run(STAMPS, late(z[:, 0]), shown)
    np.testing.assert_array_equal(now.t, STAMPS)
    # Where inputs come late, they have to have been constant over the delay.
    at_end = slice(COUNT - 8 if share else COUNT // 2, None)
    np.testing.assert_allclose(now.z[at_end], z[at_end], atol=1e-6)
    np.testing.assert_allclose(now.unknown_input[at_end], d[at_end], atol=1e-6)
    before = slice(at_end.start - LATE, COUNT - LATE)
    np.testing.assert_allclose(then.z[at_end], z[before], atol=1e-6)
    assert np.abs(then.z[at_end, 1] - z[at_end, 1]).max() > 0.02  # so the delay matters


def test_where_the_model_leaves_the_finite_numbers_the_estimate_of_then_stands():
    late = {'order': 1, 'phi': ['z1**60'], 'measurement_delay': 1.0, 'predict_to_now': True}
    estimator = OnlineEstimator(late | {'gains': 'fixed'})
    estimator.update(FIRST, 5.0)
    assert estimator.estimate.z == [5.0]


TWO = {
    'order': 1, 'phi': ['0*a*b'], 'inputs': ['a', 'b'], 'gains': 'fixed', 'variant': 'sign',
    'spike_gate': 1.0,
}  # fmt: skip


def acting(pieces, lag, elapsed, now, spikes=()):
    """Return the inputs that act in a step of `elapsed` ns, after pieces of (duration, a, b)."""
    estimator = OnlineEstimator(TWO | {'measurement_delay': lag * 1e-9})
    rows = [(0, 0.0, 0.0, 0.0), *((*piece, 0.0) for piece in pieces)]
    rows += [(duration, 5.0, 5.0, 9.0) for duration in spikes]  # samples that are rejected
    rows = np.array([*rows, (elapsed, *now, 0.0)])
    stamps = FIRST + np.cumsum(rows[:, 0]).astype(np.int64)
    if len(spikes):  # each was as if it had not come
        begin = stamps[len(pieces)]
        stamps[len(pieces) + 1 :] = begin + rows[len(pieces) + 1 :, 0].astype(np.int64)
    *_, found = estimator.policy.run(stamps, rows[:, 3].copy(), rows[:, 1:3].copy())
    assert estimator.counters.rejected_spikes == len(spikes)
    return found[-1]


durations, values = st.integers(1, 50), st.integers(-2, 2)


@given(st.lists(st.tuples(durations, values, values), max_size=30), st.integers(1, 200), durations)
def test_inputs_of_an_interval_are_their_mean_and_what_is_withdrawn_has_not_been(
    pieces, lag, elapsed
):
    now = np.array([9.0, -9.0])
    series = [np.array(u, dtype=float) for duration, *u in pieces for _ in range(duration)]
    series += [now] * 61
    series = np.array([series[0]] * (lag + 61) + series)
    for last, spikes in (elapsed, ()), (61, [elapsed, 60]):
        end = len(series) - 61 + last
        wanted = series[end - lag - last : end - lag].mean(axis=0)
        np.testing.assert_allclose(acting(pieces, lag, last, now, spikes), wanted, atol=1e-12)


def test_more_pieces_than_there_is_room_for_lose_the_oldest():
    count = 512 + 100
    pieces = [(10, k, -k) for k in range(count)]
    now = np.zeros(2)
    for back in (1, 100, 510):
        newest = count - 1 - back
        found = acting(pieces, 10 * (back + 1), 10, now)
        np.testing.assert_array_equal(found, [newest, -newest])
    np.testing.assert_array_equal(acting(pieces, 10 * count, 10, now)[0], count - 512)


def test_recordings_have_the_delay():
    signals = {'integration_step': 1e-3, 'duration': 4.0, 'phi': ['0', '0', 'u - z3']}
    punctual, delayed = (
        Family(signals | {'measurement_delay': delay}).recording(0) for delay in (0.0, 0.05)
    )
    np.testing.assert_allclose(delayed.z, punctual.z, atol=1e-9)
    np.testing.assert_allclose(delayed.y[50:], punctual.z[:-50, 0], atol=1e-9)
