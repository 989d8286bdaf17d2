# SPDX-License-Identifier: Apache-2.0
"""Faults of time and of values: each case of docs/node.md, its effect and its counter."""

import math

from fhaosmo_ros.core import Observer, OnlineEstimator, Status
import numpy as np
from observer_cases import laws, levels_of, place
import pytest

MS = 1_000_000
START = 1_700_000_000 * 10**9
HOUR, NO_STAMP = 3_600_000, -START // MS - 49
"""In milliseconds."""
NAN = math.nan


class Feed:
    """An estimator, and what it says of samples at 1 kHz; `now` is the time of the latest."""

    def __init__(self, **parameters):
        self.estimator, self.now = OnlineEstimator(parameters), -1

    def at(self, now, y):
        """Feed a sample of a time (ms)."""
        return self.estimator.update(START + round(now * MS), y).status

    def __call__(self, *values):
        begin, self.now = self.now + 1, self.now + len(values)
        return [self.at(begin + k, y) for k, y in enumerate(values)]

    def sine(self, count=50):
        return self(*(0.2 + 0.1 * math.sin(0.01 * (self.now + 1 + k)) for k in range(count)))

    @property
    def numbers(self):
        return [*self.estimator.estimate.z, self.estimator.estimate.unknown_input]

    def only(self, **expected):
        """Assert that these counters, and no others but accepted, are not 0."""
        counters = self.estimator.counters._asdict()
        assert {k: v for k, v in counters.items() if v and k != 'accepted'} == expected

    def same(self, other):
        one, other = self.estimator, other.estimator
        np.testing.assert_array_equal(levels_of(one.observer), levels_of(other.observer))
        assert one.estimate.gamma == other.estimate.gamma
        assert one.stamp == other.stamp


def of(*times, y=0.21):
    return [(time, y) for time in times]


GATE, STUCK = {'spike_gate': 0.05}, {'stuck_time': 0.1}
FAULTS = {
    # Parameters; samples after 50 usual ones, by the time since the last of these (ms); what
    # becomes of each: - used, x rejected, h held and dropped, H held until r, the restart from
    # both, g used after a gap; counters.
    'twice': ({}, [(0, 5.0), (1, 0.21)], 'x-', {'duplicate_stamps': 1}),
    'late': ({}, [(-3, 5.0), (-499, 5.0), (1, 0.21)], 'xx-', {'backward_stamps': 2}),
    'no stamp': ({}, [(NO_STAMP, 5.0), (1, 0.21)], 'x-', {'zero_stamps': 1}),
    'a gap': ({}, of(300), 'g', {'gaps': 1, 'sub_steps': 300}),
    'an hour': ({'max_gap': 3600.0}, of(HOUR - 1), 'g', {'gaps': 1, 'sub_steps': 10_000}),
    'set back a little': (
        {}, of(*range(-99, 50)), 'x' * 100 + '-' * 49,
        {'backward_stamps': 99, 'duplicate_stamps': 1},
    ),
    'one ahead, which ends a gap': (
        {}, of(30, *range(1, 40)), 'g' + 'x' * 30 + '-' * 9,
        {'backward_stamps': 29, 'duplicate_stamps': 1, 'gaps': 1, 'sub_steps': 30},
    ),
    **{
        f'one {far} ms away': (
            {}, [(far, 5.0), (1, 0.21), (far + 2, 5.0), (3, 0.21)], 'h-h-', {'far_stamps': 2}
        )
        for far in (HOUR, -HOUR, 10**12, -(10**12), 7 * 10**12, 2**63, 10**24)
    },
    **{
        f'from {far} ms away on': (
            {}, [(far, 0.3), (far + 1, 0.31), (far + 2, 0.32)], 'Hr-',
            {'far_stamps': 1, f'restarts_{"forward" if far > 0 else "backward"}': 1},
        )
        for far in (600, -600, 10**12, -(10**12))
    },
    'two far away that do not fit': (
        {}, [(600, 3.0), (5 * HOUR, 0.4), (5 * HOUR + 1, 0.4)], 'hr-',
        {'far_stamps': 1, 'restarts_forward': 1},
    ),
    'a thousand times as slow from now on': (
        {}, of(1000, 2000, 3000, 4000), 'hr--', {'far_stamps': 1, 'restarts_forward': 1}
    ),
    'no y': (
        {}, [(1, NAN), (2, math.inf), (3, -math.inf), (4, 2e100), (5, -1.7e308), (6, 0.21)],
        'xxxxxg', {'rejected_measurements': 5, 'gaps': 1, 'sub_steps': 6},
    ),
    'no y for longer than max_gap': (
        {'max_gap': 0.5}, of(*range(1, 2001), y=NAN) + of(2001, 2002), 'x' * 2000 + 'Hr',
        {'rejected_measurements': 2000, 'far_stamps': 1, 'restarts_forward': 1},
    ),
    'spikes': (
        GATE, [(k, 5.0 if k % 6 else 0.21) for k in range(1, 31)], 'xxxxxg' * 5,
        {'rejected_spikes': 25, 'gaps': 5, 'sub_steps': 24},
    ),
    'a step, which is believed': (
        GATE, of(*range(1, 51), y=5.0), 'x' * 5 + 'g' + '-' * 44,
        {'rejected_spikes': 5, 'spikes_believed': 1, 'gaps': 1, 'sub_steps': 6},
    ),
    'stuck': (
        STUCK, of(*range(1, 301), y=0.25) + of(301), '-' * 101 + 'x' * 199 + 'g',
        {'stuck': 1, 'rejected_stuck': 199, 'gaps': 1, 'sub_steps': 200},
    ),
    'silence, which is no stuck sensor': (
        STUCK, of(1) + of(*range(20_000, 20_050)), '-Hr' + '-' * 48,
        {'far_stamps': 1, 'restarts_forward': 1},
    ),
}  # fmt: skip


def letter(status):
    kinds = {'h': Status.HELD, 'r': Status.RESTARTED, 'g': Status.GAP}
    found = [key for key, kind in kinds.items() if status & kind]
    return found[0] if found else 'x' if status.rejected else '-'


@pytest.mark.parametrize('name', FAULTS)
def test_what_becomes_of_a_sample_and_what_is_rejected_has_not_been(name):
    parameters, samples, expected, counters = FAULTS[name]
    feed, other = Feed(**parameters), Feed(**parameters | {'spike_gate': 0.0})
    feed.sine()
    kinds = list(zip(samples, expected, strict=True))
    for (time, y), kind in kinds:
        before = feed.numbers
        assert letter(feed.at(49 + time, y)) == kind.lower()
        assert kind not in 'xhH' or feed.numbers == before
    feed.only(**counters)
    known = feed.estimator.counters
    assert known.accepted + known.rejected == 50 + len(samples)
    afresh = max(expected.find('H'), expected.find('r') * ('H' not in expected))
    if afresh < 0:
        other.sine()
    for (time, y), kind in kinds[max(afresh, 0) :]:
        if kind not in 'xh':
            other.at(49 + time, y)
    feed.same(other)


def test_bag_that_loops_restarts():
    many, within = Feed(), Feed(max_gap=5.0)
    for feed, length, rounds in ((many, 2000, 4), (within, 400, 3)):
        for _ in range(rounds):
            feed.now = -1
            feed.sine(length)
    many.only(far_stamps=3, restarts_backward=3)
    # Within max_gap time does not catch up: followed after so many late samples.
    within.only(backward_stamps=500, duplicate_stamps=1, restarts_backward=1)


@pytest.mark.parametrize('step', [1, 20, 400])
def test_slow_sensor_is_not_cut_up(step):
    feed = Feed()
    for k in range(100):
        feed.at(k * step, 0.2)
    feed.only()
    assert feed.estimator.period == pytest.approx(step * 1e-3)


def bridged(law, y):
    """Return an observer after 33 equal samples at 100 Hz and `y` four periods later."""
    feed = Feed(**{'order': 1, 'scheme': 'explicit', 'variant': 'fuzzy'} | law)
    for k in range(33):
        feed.at(10 * k, 0.5)
    return feed.estimator.observer, feed.at(360, y)


def test_bridge_ends_where_steps_at_the_predicted_samples_end():
    # Phi = 0 and no motion: the model predicts the last sample, so y is a line to the new one.
    found, status = bridged({'phi': ['0'], 'scheme': 'implicit'}, 0.9)
    assert status == Status.GAP
    observer = Observer({'order': 1, 'phi': ['0'], 'scheme': 'implicit', 'variant': 'fuzzy'})
    observer.run(0.01 * np.arange(37), [0.5] * 33 + [0.6, 0.7, 0.8, 0.9])
    np.testing.assert_allclose(levels_of(found), levels_of(observer), atol=1e-12)
    found, status = bridged({'phi': ['-z1**60'], 'variant': 'fuzzy_adaptive'}, 1e9)
    assert status == Status.GAP | Status.REJECTED_STEP
    assert np.isfinite(levels_of(found)).all()


def test_gate_is_around_the_prediction_not_around_the_last_sample():
    # 10 units a second: after 100 ms of silence y is 1 further, and no spike.
    feed = Feed(spike_gate=0.05, phi=['0', '0', '0'])
    place(feed.estimator, 0.0, 10.0, 0.0, 0.0)
    assert not any(w.rejected for w in feed(*[0.01 * k for k in range(100)]))
    assert feed.at(200, 2.0) & Status.GAP
    assert feed.at(201, 1.0) == Status.REJECTED_SPIKE


def test_nominal_sampling_ignores_stamps():
    nominal, stamped = Feed(sampling='nominal', nominal_period=0.002), Feed()
    for k, wild in enumerate([0, 10**9, -5, 7] * 25):
        y = 0.2 + 0.1 * math.sin(0.01 * k)
        nominal.at(wild, y)
        stamped.at(2 * k, y)
        assert nominal.estimator.stamp == START + wild * MS
    assert nominal.numbers == stamped.numbers
    nominal.only()
    slow = Feed(sampling='nominal', nominal_period=2.0)  # no gap
    slow.sine()
    slow.only()


def test_change_of_clock_takes_the_usual_period_once():
    feed, other = Feed(), Feed()
    for f in (feed, other):
        f.sine()
    feed.estimator.configure({'sampling': 'clock'})
    for k in range(50, 53):
        feed.at(k - START // MS, 0.21)
        other.at(k, 0.21)
    assert feed.numbers == other.numbers
    feed.only()


def test_jitter_of_half_a_period_and_bursts_need_no_policy():
    rng, k = np.random.default_rng(1), np.arange(5000)
    jittering, bursting = OnlineEstimator(), OnlineEstimator()
    jittering.run(START + MS * k + rng.integers(-MS // 2, MS // 2, 5000), np.full(5000, 0.2), 0.0)
    c = jittering.counters
    assert c.rejected == c.duplicate_stamps
    assert c.gaps < 50  # where two far ends meet
    assert jittering.period == pytest.approx(1e-3, rel=0.3)
    bursting.run(START + k // 10 * 10 * MS + k % 10 * 5000, np.full(5000, 0.2), 0.0)
    c = bursting.counters
    assert c.restarts <= 1  # the first pause is taken for a gap
    assert c.accepted >= 4998
    assert c.bursts > 4250
    assert c.sub_steps < 500 * 25  # the mean does not shrink to the burst's
    assert bursting.period == pytest.approx(1e-3, rel=0.3)


@laws
def test_wild_sample_does_not_spoil_the_rest(law):
    """One accepted sample of 1e11: sign at these gains would need a day to come back."""
    feed = Feed(**law, divergence_time=0.1, **{'lambda': 15.0, 'alpha': 30.0, 'epsilon': 1.0})
    feed.sine(200)
    feed(1e11)
    feed.sine(1000)
    assert abs(feed.numbers[0] - 0.2) < 0.2
    assert feed.estimator.counters.divergences == 1


@laws
def test_steps_that_always_fail_start_afresh_and_never_end_in_nan(law):
    feed = Feed(order=1, phi=['log(z1)'], divergence_time=0.01, **law)
    assert any(w & Status.DIVERGED for w in feed(*[-1.0] * 100))
    assert feed.numbers[0] == -1.0
    assert feed.estimator.counters.rejected_steps > 50


def test_state_beyond_the_limit_starts_afresh_at_once_but_no_other():
    feed = Feed(divergence_time=0.0, epsilon=1e-9)
    feed.sine(2000)
    feed.only()
    place(feed.estimator, 0.2, 1.1e60, 1.1e60, 1.1e60)
    assert sum(bool(w & Status.DIVERGED) for w in feed.sine(20)) == 1
    feed.only(divergences=1)


def test_spikes_beyond_epsilon_are_no_divergence_while_y_is_found_again():
    feed = Feed(epsilon=0.3, divergence_time=0.05)
    feed.sine(1000)
    for _ in range(20):
        feed(2.0)
        assert abs(feed.estimator.estimate.innovation[0]) > 0.3
        feed.sine(20)
    feed.only()


def test_gamma_is_held_while_its_rate_and_leakage_are_0():
    feed, other = Feed(gamma_rate=0.5), Feed(gamma_rate=0.5)
    for f in (feed, other):
        f.sine()
    gamma = feed.estimator.estimate.gamma
    feed.estimator.configure({'gamma_rate': 0.0, 'gamma_leakage': 0.0})
    for f in (feed, other):
        f.now += 100  # a gap
        f.sine()
    assert feed.estimator.estimate.gamma == gamma
    assert other.estimator.estimate.gamma != gamma
    feed.estimator.configure({'gamma_rate': 0.5})
    feed.sine()
    assert feed.estimator.estimate.gamma != gamma


@pytest.mark.parametrize('from_measurement', [True, False])
def test_reset_keeps_parameters_and_counters_and_forgets_the_rest(from_measurement):
    start = {
        'initial_estimate': [0.5, 1.0, 2.0, 3.0], 'initial_internal': [1.0, 2.0, 3.0, 0.0],
        'start_from_measurement': from_measurement,
    }  # fmt: skip
    feed, fresh = Feed(), Feed(**start)
    feed.sine(100)
    feed(NAN)
    feed.estimator.configure(start)
    feed.estimator.reset()
    assert feed.estimator.period == 0.0
    for f in (feed, fresh):
        assert (f.estimator.estimate, f.estimator.stamp) == (None, None)
        f.now = 7  # before the time of the last reset
        f(0.7)
        assert f.numbers == [0.7 if from_measurement else 0.5, 1.0, 2.0, 3.0]
        f.sine()
    feed.same(fresh)
    feed.only(rejected_measurements=1)


def test_a_value_that_a_slow_sensor_repeats_after_a_reset_has_finite_innovations():
    feed = Feed(gains='self_tuning', order=2, phi=['0', '-3*z2'])
    noise = 1e-3 * np.random.default_rng(1).standard_normal(100)
    y = np.repeat(np.sin(0.01 * np.arange(100)) + noise, 4).tolist()
    assert feed(*y)[-1] == Status.REPEATED
    feed.estimator.reset()
    assert feed(y[-1]) == [Status.REPEATED]
    np.testing.assert_array_equal(feed.estimator.observer.estimate.innovation, 0.0)
