# SPDX-License-Identifier: Apache-2.0
"""Faults of time: each case of docs/node.md, its effect and its counter."""

import math

from fhaosmo_ros.core import Observer
from fhaosmo_ros.core.observer.status import REJECTED, Status
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.policy import MOST_SUB_STEPS
import numpy as np
from observer_cases import levels_of, place
import pytest
from scipy.integrate import solve_ivp

MS = 1_000_000
START = 1_700_000_000 * 10**9
HOUR = 3600 * 10**9


def sample(k: float) -> float:
    return 0.2 + 0.1 * math.sin(0.01 * k)


def run(estimator: OnlineEstimator, count: int = 50, step: int = MS) -> int:
    """Feed samples of a sine; return the last stamp."""
    for k in range(count):
        estimator.update(START + k * step, sample(k))
    return START + (count - 1) * step


def only(estimator: OnlineEstimator, **expected: int) -> None:
    """Assert that these counters, and no others but accepted, are not 0."""
    found = {k: v for k, v in estimator.counters._asdict().items() if v and k != 'accepted'}
    assert found == expected


def twins(**parameters):
    """Return two estimators that have taken the same samples, and the last stamp."""
    estimator, other = OnlineEstimator(parameters), OnlineEstimator(parameters)
    run(other)
    return estimator, other, run(estimator)


def same(estimator: OnlineEstimator, other: OnlineEstimator) -> None:
    np.testing.assert_array_equal(levels_of(estimator.observer), levels_of(other.observer))
    assert estimator.estimate.gamma == other.estimate.gamma


# Stamps


@pytest.mark.parametrize('back', [0, 1, 3 * MS, 499 * MS])
def test_late_or_duplicate_sample_is_rejected_and_the_next_one_counts_from_the_latest(back):
    estimator, other, last = twins()
    assert estimator.update(last - back, 5.0).status & Status.REJECTED_PERIOD
    only(estimator, **{'backward_stamps' if back else 'duplicate_stamps': 1})
    for e in (estimator, other):
        e.update(last + MS, 0.21)
    same(estimator, other)


@pytest.mark.parametrize('sampling', ['source_stamp', 'clock'])
def test_stamp_zero_is_no_time(sampling):
    estimator = OnlineEstimator({'sampling': sampling})
    for _ in range(3):
        assert estimator.update(0, 0.2).status & Status.REJECTED_PERIOD
    assert estimator.estimate is None
    last = run(estimator)
    estimator.update(0, 0.2)
    estimator.update(last + MS, 0.2)
    only(estimator, zero_stamps=4)
    assert estimator.counters.accepted == 51


@pytest.mark.parametrize('jump', [HOUR, -HOUR, 10**18, -(10**18), 7 * 10**18, 2**63, 10**30])
def test_single_stamps_far_away_are_dropped_and_time_goes_on(jump):
    estimator, other, last = twins()
    for k in range(1, 20, 2):
        status = estimator.update(START + jump + k * MS, 5.0).status
        assert status == Status.REJECTED_PERIOD | Status.HELD
        for e in (estimator, other):
            e.update(last + k * MS, 0.21)
    same(estimator, other)
    only(estimator, far_stamps=10)


@pytest.mark.parametrize('jump', [600 * MS, -600 * MS, 10**18, -(10**18)])
def test_second_sample_beyond_max_gap_restarts_from_both(jump):
    estimator, fresh = OnlineEstimator(), OnlineEstimator()
    last = run(estimator)
    held, second, third = ((last + jump + k * MS, 0.3 + 0.01 * k) for k in range(3))
    before = estimator.estimate
    np.testing.assert_array_equal(estimator.update(*held).z, before.z)
    assert estimator.stamp == last
    words = [estimator.update(*one).status for one in (second, third)]
    assert [word & Status.RESTARTED for word in words] == [Status.RESTARTED, 0]
    assert not words[0].rejected
    for one in (held, second, third):
        fresh.update(*one)
    same(estimator, fresh)
    assert estimator.stamp == third[0]
    direction = 'restarts_forward' if jump > 0 else 'restarts_backward'
    only(estimator, far_stamps=1, **{direction: 1})
    assert estimator.counters.restarts == 1
    # Two far stamps that do not fit each other: the second one counts.
    estimator, fresh = OnlineEstimator(), OnlineEstimator()
    run(estimator)
    estimator.update(last + jump, 3.0)
    for e in (estimator, fresh):
        e.update(last + 5 * HOUR, 0.4)
        e.update(last + 5 * HOUR + MS, 0.4)
    same(estimator, fresh)


@pytest.mark.parametrize(('behind', 'rejected', 'counted'), [
    # One stamp is ahead by less than max_gap: it ends a gap, and time goes on from it.
    ([30, *range(1, 40)], [False] + [True] * 30 + [False] * 9,
     {'backward_stamps': 29, 'duplicate_stamps': 1, 'gaps': 1, 'sub_steps': 30}),
    # A clock is set back a little.
    (range(-99, 50), [True] * 100 + [False] * 49, {'backward_stamps': 99, 'duplicate_stamps': 1}),
], ids=['one stamp ahead', 'clock set back'])  # fmt: skip
def test_samples_are_held_until_time_has_caught_up(behind, rejected, counted):
    estimator, _, last = twins()
    words = [estimator.update(last + k * MS, 0.2).word for k in behind]
    assert [bool(w & REJECTED) for w in words] == rejected
    assert bool(words[0] & Status.GAP) == ('gaps' in counted)
    only(estimator, **counted)


@pytest.mark.parametrize(('parameters', 'length', 'rounds', 'counted'), [
    ({}, 2000, 4, {'far_stamps': 3, 'restarts_backward': 3}),
    # Within max_gap time does not catch up: followed after so many late samples.
    ({'max_gap': 5.0}, 400, 3,
     {'backward_stamps': 500, 'duplicate_stamps': 1, 'restarts_backward': 1}),
], ids=['once a round', 'within max_gap'])  # fmt: skip
def test_bag_that_loops_restarts(parameters, length, rounds, counted):
    estimator = OnlineEstimator(parameters)
    for _ in range(rounds):
        run(estimator, length)
    only(estimator, **counted)


# Gaps


def test_gap_up_to_max_gap_is_bridged_in_a_bounded_number_of_steps():
    estimator = OnlineEstimator({'max_gap': 3600.0})
    last = run(estimator)
    assert estimator.update(last + 300 * MS, 0.2).status & Status.GAP
    only(estimator, gaps=1, sub_steps=300)
    estimator.reset()
    run(estimator)
    estimator.update(last + HOUR, 0.2)
    only(estimator, gaps=2, sub_steps=300 + MOST_SUB_STEPS)


@pytest.mark.parametrize('decay', [0.0, 3.0])
def test_prediction_is_the_plant_to_fourth_order(decay):
    start, u, d = np.array([0.4, -0.3, 0.8]), 0.7, 0.5

    def slope(_, z):
        return [z[1] + u - z[0], z[2] + np.sin(z[0]), z[3] - z[2] * z[1], -decay * z[3]]

    truth = solve_ivp(slope, (0.0, 0.5), [*start, d], rtol=1e-12, atol=1e-12).y[0, -1]

    def predicted(n):
        estimator = OnlineEstimator({
            'phi': ['u - z1', 'sin(z1)', '-z3*z2'], 'unknown_input_decay': decay,
            'gains': 'fixed', 'predict_to_now': True, 'prediction_step': 0.5 / n,
            'measurement_delay': 0.5, 'input_delay': 0.5,
        })  # fmt: skip
        estimator.set_input(u)
        estimator.update(START, 0.0)
        place(estimator, *start, d)
        return estimator.estimate.z[0]

    errors = [abs(predicted(n) - truth) for n in (10, 20, 40)]
    assert errors[-1] < 1e-8
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 16.0, rtol=0.2)


def test_slow_sensor_is_not_cut_up_and_a_fast_one_is():
    for step in (MS, 20 * MS, 400 * MS):
        estimator = OnlineEstimator()
        run(estimator, 100, step=step)
        only(estimator)
        assert estimator.period == pytest.approx(step * 1e-9)
        assert estimator.jitter == 0.0


def bridged(law, y, d=None):
    """Return an estimator after 33 equal samples at 100 Hz and `y` four periods later."""
    estimator = OnlineEstimator({'order': 1, 'scheme': 'explicit', 'variant': 'fuzzy'} | law)
    for k in range(33):
        estimator.update(START + k * 10 * MS, 0.5)
    if d:
        place(estimator, 0.5, d)
    return estimator, estimator.update(START + 360 * MS, y).status


def test_bridge_ends_where_steps_at_the_predicted_samples_end():
    # Phi = 0 and no motion: the model predicts the last sample, so y is a line to the new one.
    estimator, status = bridged({'phi': ['0'], 'scheme': 'implicit'}, 0.9)
    assert status == Status.GAP
    observer = Observer({'order': 1, 'phi': ['0'], 'scheme': 'implicit', 'variant': 'fuzzy'})
    observer.run(0.01 * np.arange(37), [0.5] * 33 + [0.6, 0.7, 0.8, 0.9])
    np.testing.assert_allclose(levels_of(estimator.observer), levels_of(observer), atol=1e-12)
    # Without a prediction it is a straight line: that d leaves the logarithm's domain.
    estimator, status = bridged({'phi': ['log(z1)*0']}, 0.9, d=-1e9)
    assert status == Status.GAP
    assert estimator.estimate.z[0] == pytest.approx(-4e7, rel=0.1)  # what d leads to
    estimator, status = bridged({'phi': ['-z1**60'], 'variant': 'fuzzy_adaptive'}, 1e9)
    assert status == Status.GAP | Status.REJECTED_STEP
    assert np.isfinite(levels_of(estimator.observer)).all()


@pytest.mark.parametrize('sampling', ['source_stamp', 'nominal'])
def test_bad_samples_for_longer_than_max_gap_restart_too(sampling):
    estimator = OnlineEstimator({'sampling': sampling, 'max_gap': 0.5})
    fresh = OnlineEstimator({'sampling': sampling})
    last = run(estimator)
    for k in range(1, 2001):
        estimator.update(last + k * MS, math.nan)
    for k in (2001, 2002):
        for e in (estimator, fresh):
            e.update(last + k * MS, 0.5)
    same(estimator, fresh)
    held = {'far_stamps': 1} if sampling == 'source_stamp' else {}
    only(estimator, rejected_measurements=2000, restarts_forward=1, **held)


# Sampling


def test_nominal_sampling_ignores_stamps():
    options = {'sampling': 'nominal', 'nominal_period': 0.002}
    nominal, stamped = OnlineEstimator(options), OnlineEstimator()
    for k, wild in enumerate([0, 10**15, -5, 7] * 25):
        nominal.update(wild, sample(k))
        stamped.update(START + k * 2 * MS, sample(k))
        assert nominal.stamp == wild
    same(nominal, stamped)
    only(nominal)
    slow = OnlineEstimator({'sampling': 'nominal', 'nominal_period': 2.0})  # no gap
    run(slow)
    only(slow)


def test_change_of_clock_takes_the_usual_period_once():
    estimator, other, last = twins()
    estimator.configure({'sampling': 'clock'})
    for k in range(1, 4):
        estimator.update(k * MS, 0.21)
        other.update(last + k * MS, 0.21)
    same(estimator, other)
    only(estimator)


def times_by(readings):
    """Return the times of samples that came when the clock read so; 0 before there is one."""
    estimator = OnlineEstimator({'sampling': 'clock'})
    found = []
    for k, reading in enumerate(readings.tolist()):
        estimator.update(reading, sample(k))
        found.append(estimator.stamp)
    assert estimator.counters.restarts == estimator.counters.backward_stamps == 0
    return np.array(found), estimator


TRUE = START + MS * np.arange(10_000)
SLOW = START + MS * (np.arange(10_000) // 25 * 25)
"""Times at 1 kHz, and what a clock of 40 Hz reads then."""


def clock_readings(published, per_tick, lateness, seed):
    """
    Return what a clock on /clock reads when each sample comes.

    The time is published 20 µs before every `per_tick`-th sample; messages of both are late by a
    half-normal time of this scale (s), and what is late holds up what was published after it.
    """
    rng = np.random.default_rng(seed)

    def received(times):
        late = 1e9 * lateness * np.abs(rng.standard_normal(len(times)))
        return np.maximum.accumulate(times + late.astype(np.int64))

    ticks = published[::per_tick]
    latest = np.searchsorted(received(ticks - 20_000), received(published), side='right')
    return ticks[np.maximum(latest, 1) - 1]


@pytest.mark.parametrize('late', [0.0, 1e-5, 1e-4, 1e-3])
def test_late_ticks_and_samples_hardly_move_the_times(late):
    for seed in range(3):
        times = times_by(clock_readings(TRUE, 25, late, seed))[0][5000:]
        assert np.diff(times) == pytest.approx(MS, rel=0.002)
        assert times == pytest.approx(TRUE[5000:], abs=MS)


def test_clock_that_ticks_slower_than_samples_come_spreads_them():
    """1 kHz on a clock of 40 Hz: from the third tick on as if it had true stamps."""
    times, ticked = times_by(SLOW)
    true = OnlineEstimator()
    true.run(TRUE, [sample(k) for k in range(len(TRUE))])
    assert np.abs(times - TRUE)[100:].max() <= 13 * MS
    assert ticked.period == pytest.approx(1e-3, rel=0.1)
    np.testing.assert_allclose(ticked.estimate.z, true.estimate.z, atol=0.05)
    assert ticked.counters.spread_stamps > 9300
    assert ticked.counters.far_stamps == 0


@pytest.mark.parametrize('reading', [5090, 5005], ids=['ticks first', 'samples first'])
def test_node_that_stands_for_a_moment_moves_no_times(reading):
    """For 90 ms; then what has come is taken at once."""
    readings = SLOW.copy()
    readings[5005:5095] = SLOW[reading]
    assert np.diff(times_by(readings)[0][2000:]) == pytest.approx(MS, rel=0.002)


@pytest.mark.parametrize('tick', [1, 25])
def test_times_of_a_sensor_that_is_not_steady_are_those_of_the_clock(tick):
    """Its samples are no line; each time is right within two ticks and two samples."""
    intervals = np.random.default_rng(0).exponential(2 * MS, 8000).astype(np.int64)
    true = START + np.cumsum(np.maximum(intervals, 1000))
    times, _ = times_by(true // (tick * MS) * (tick * MS))
    assert np.median(np.abs(times - true)[4000:]) < 2 * (tick + 2) * MS


def test_samples_are_back_at_the_clock_after_a_gap():
    times, _ = times_by(np.delete(SLOW, np.s_[5005:5405]))
    assert times[5005] == pytest.approx(TRUE[5405], abs=30 * MS)
    assert times[5500:] == pytest.approx(TRUE[5900:], abs=30 * MS)


def test_clock_that_stands_still_is_two_samples_ahead_of_its_next_tick_at_most():
    ticks = np.repeat([0, 10, 20], [5, 5, 1005])  # paused: samples go on
    times, estimator = times_by(START + MS * ticks)
    assert times[-1] <= START + (30 + 2 * 2) * MS  # 2 ms between samples
    assert not estimator.update(START + 30 * MS, 0.2).status.rejected


def test_tick_that_comes_early_makes_no_sample_late():
    ticks = np.cumsum([0, 25, 25, 25, 13, 25, 25, 12, 25])
    _, estimator = times_by(START + MS * np.repeat(ticks, 25))
    assert estimator.counters.accepted > 150


@pytest.mark.parametrize('together', [25, 1])
def test_samples_of_a_clock_that_jumps_back_restart_within_one_tick(together):
    estimator = OnlineEstimator({'sampling': 'clock'})
    for k in range(500):
        estimator.update(START + k // together * together * MS, sample(k))
    for k in range(50):
        estimator.update(10 * MS + k // together * together * MS, sample(k))
    counters = estimator.counters
    assert counters.restarts_backward == counters.restarts == 1
    assert 0 < estimator.stamp < 100 * MS


def test_jitter_of_half_a_period_needs_no_policy():
    rng = np.random.default_rng(1)
    stamps = START + MS * np.arange(5000) + rng.integers(-MS // 2, MS // 2, 5000)
    estimator = OnlineEstimator()
    estimator.run(stamps, np.full(5000, 0.2), 0.0)
    c = estimator.counters
    assert c.accepted + c.duplicate_stamps == 5000
    assert c.gaps < 50  # where two far ends meet
    assert estimator.period == pytest.approx(1e-3, rel=0.3)
    assert estimator.jitter == pytest.approx(1e-3 / 3, rel=0.6)  # mean |u - v| of uniforms


def test_bursts_are_counted_and_used():
    estimator = OnlineEstimator()
    late = START + np.arange(2000) // 10 * 10 * MS + np.arange(2000) % 10 * 5000
    estimator.run(late, np.full(2000, 0.2), 0.0)
    c = estimator.counters
    assert c.restarts <= 1  # the first pause is taken for a gap
    assert c.accepted >= 1998
    assert c.bursts > 1700
    assert c.sub_steps < 200 * 25  # the mean does not shrink to the burst's
    assert estimator.period == pytest.approx(1e-3, rel=0.3)
