# SPDX-License-Identifier: Apache-2.0
"""Faults of values: each case of docs/node.md and its counter; freezing and seeding."""

import math

from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
import numpy as np
from observer_cases import laws, levels_of, place
import pytest

MS = 1_000_000
START = 1_700_000_000 * 10**9


class Feed:
    """Feeds samples at 1 kHz."""

    def __init__(self, **parameters) -> None:
        self.estimator = OnlineEstimator(parameters)
        self.count = 0

    def __call__(self, *values: float) -> list[Status]:
        begin, self.count = self.count, self.count + len(values)
        stamps = range(START + begin * MS, START + self.count * MS, MS)
        return [self.estimator.update(*one).status for one in zip(stamps, values, strict=True)]

    def sine(self, count: int) -> list[Status]:
        k = range(self.count, self.count + count)
        return self(*(0.2 + 0.1 * math.sin(1e-3 * j) for j in k))

    @property
    def events(self) -> dict[str, int]:
        counters = self.estimator.counters._asdict().items()
        return {k: v for k, v in counters if v and k not in ('accepted', 'gaps', 'sub_steps')}

    @property
    def numbers(self) -> list[float]:
        estimate = self.estimator.estimate
        return [*estimate.z, estimate.unknown_input]


# Values that are none, spikes


@pytest.mark.parametrize(('bad', 'gate'), [
    (math.nan, 0.0), (math.inf, 0.0), (-math.inf, 0.0), (2e100, 0.0), (-1.7e308, 0.0), (0.5, 0.05),
])  # fmt: skip
def test_bad_value_is_rejected_and_as_if_it_had_not_come(bad, gate):
    feed, other = Feed(spike_gate=gate), Feed()
    for f in (feed, other):
        f.sine(100)
    before = feed.numbers
    assert feed(bad) == [Status.REJECTED_SPIKE if gate else Status.REJECTED_MEASUREMENT]
    np.testing.assert_array_equal(feed.numbers, before)
    other.count += 1
    for f in (feed, other):
        f.sine(5)
    np.testing.assert_array_equal(
        levels_of(feed.estimator.observer), levels_of(other.estimator.observer)
    )
    assert feed.events == {'rejected_spikes' if gate else 'rejected_measurements': 1}


def test_bad_input_is_not_held():
    estimator = OnlineEstimator({'phi': ['0', '0', 'u']})
    assert [estimator.set_input(u) for u in (2.0, math.nan, -math.inf)] == [True, False, False]
    assert estimator.inputs == (2.0,)
    assert (estimator.counters.rejected_inputs, estimator.counters.rejected) == (2, 0)


def test_real_step_of_y_is_believed_after_five_samples_in_a_row():
    feed = Feed(spike_gate=0.05)
    feed.sine(100)
    for _ in range(10):
        words = feed(*[5.0, -5.0] * 2, 5.0, 0.21)
        assert [w.rejected for w in words] == [True] * 5 + [False]
    assert feed.events == {'rejected_spikes': 50}
    words = feed(*[5.0] * 50)
    assert [bool(w & Status.REJECTED_SPIKE) for w in words] == [True] * 5 + [False] * 45
    assert feed.events == {'rejected_spikes': 55, 'spikes_believed': 1}


def test_gate_is_around_the_prediction_not_around_the_last_sample():
    # 10 units a second: after 100 ms of silence y is 1 further, and no spike.
    feed = Feed(spike_gate=0.05, phi=['0', '0', '0'])
    place(feed.estimator, 0.0, 10.0, 0.0, 0.0)
    assert not any(w.rejected for w in feed(*[0.01 * k for k in range(100)]))
    feed.count += 100
    (word,) = feed(0.01 * feed.count)
    assert word & Status.GAP
    assert feed(0.01 * 99) == [Status.REJECTED_SPIKE]


# A stuck sensor


def test_stuck_sensor_is_rejected_until_it_moves():
    feed = Feed(stuck_time=0.1)
    feed.sine(100)
    words = feed(*[0.25] * 300)
    assert [w.rejected for w in words] == [False] * 101 + [True] * 199
    assert words[-1] == Status.REJECTED_STUCK
    assert feed.estimator.stamp == START + 200 * MS
    assert feed(0.26)[0] & Status.GAP
    assert feed.events == {'stuck': 1, 'rejected_stuck': 199}
    feed(*[0.25] * 3000)  # for longer than max_gap
    feed.sine(10)
    assert (feed.events['stuck'], feed.events['restarts_forward']) == (2, 1)
    feed(0.2)
    feed.count += 20_000  # silence is no stuck sensor
    assert not any(w & Status.REJECTED_STUCK for w in feed(*[0.2] * 50))


# Divergence


BAD_GAINS = {'scheme': 'explicit', 'variant': 'fuzzy_adaptive', 'lambda': 1e6, 'alpha': 1e9}
BAD_GAINS |= {'gamma_min': 1.0, 'gamma_initial': 1.0}


def test_bad_live_gains_are_noticed_and_survived():
    feed = Feed(epsilon=0.5, divergence_time=0.05)
    feed.sine(1000)
    before = feed.numbers
    feed.estimator.configure(BAD_GAINS)
    assert any(w & Status.DIVERGED for w in feed.sine(1000))
    assert np.isfinite([*feed.numbers, *feed.estimator.estimate.innovation]).all()
    feed.estimator.configure({k: ONLINE_PARAMETERS[k].default for k in BAD_GAINS})
    seen = feed.estimator.counters.divergences
    feed.sine(3000)
    assert feed.estimator.counters.divergences <= seen + 1
    np.testing.assert_allclose(feed.numbers[:2], before[:2], atol=0.2)


@laws
def test_wild_sample_does_not_spoil_the_rest(law):
    # One accepted sample of 1e11: without a second start, sign at these gains needs a day back.
    feed = Feed(**law, divergence_time=0.1, **{'lambda': 15.0, 'alpha': 30.0, 'epsilon': 1.0})
    feed.sine(200)
    feed(1e11)
    feed.sine(1000)
    assert abs(feed.numbers[0] - 0.2) < 0.2
    assert feed.estimator.counters.divergences == 1


def test_state_beyond_the_limit_starts_afresh_at_once():
    feed = Feed(divergence_time=0.0)
    feed.sine(10)
    place(feed.estimator, 0.2, 1.1e60, 1.1e60, 1.1e60)
    words = feed.sine(20)
    assert sum(bool(w & Status.DIVERGED) for w in words) == 1
    assert feed.events == {'divergences': 1}


@laws
def test_steps_that_always_fail_start_afresh_and_never_end_in_nan(law):
    feed = Feed(order=1, phi=['log(z1)'], divergence_time=0.01, **law)
    words = feed(*[-1.0] * 100)
    assert any(w & Status.DIVERGED for w in words)
    assert feed.numbers[0] == -1.0
    assert feed.estimator.counters.rejected_steps > 50


def test_spikes_beyond_epsilon_are_no_divergence_while_y_is_found_again():
    feed = Feed(epsilon=0.3, divergence_time=0.05)
    feed.sine(1000)
    for _ in range(20):
        feed(2.0)
        assert abs(feed.estimator.estimate.innovation[0]) > 0.3
        feed.sine(20)
    assert feed.events == {}


def test_divergence_time_zero_never_starts_afresh():
    feed = Feed(divergence_time=0.0, epsilon=1e-9)
    feed.sine(2000)
    assert feed.events == {}


# Gamma, and where an observer starts


def test_frozen_gamma_stays_and_the_rest_goes_on():
    feed, other = Feed(gamma_rate=0.5), Feed(gamma_rate=0.5)
    for f in (feed, other):
        f.sine(50)
    gamma = feed.estimator.estimate.gamma
    feed.estimator.freeze(True)
    assert feed.estimator.frozen
    feed.estimator.configure({'gamma_leakage': 10.0})
    for f in (feed, other):
        f.count += 100  # a gap
        assert f.sine(50)[0] & Status.GAP
        f.count += 1000  # a restart
        f.sine(50)
    assert feed.estimator.estimate.gamma == gamma
    assert other.estimator.estimate.gamma != gamma
    assert feed.estimator.counters.restarts == 1
    feed.estimator.freeze(False)
    feed.sine(50)
    assert feed.estimator.estimate.gamma != gamma


@pytest.mark.parametrize('from_measurement', [True, False])
def test_parameters_and_a_reset_give_the_start(from_measurement):
    feed = Feed()
    feed.sine(100)
    feed.estimator.configure({
        'initial_estimate': [0.5, 1.0, 2.0, 3.0], 'initial_internal': [1.0, 2.0, 3.0, 0.0],
        'start_from_measurement': from_measurement,
    })  # fmt: skip
    feed.estimator.reset()
    feed(0.7)
    assert feed.numbers == [0.7 if from_measurement else 0.5, 1.0, 2.0, 3.0]
    assert feed.estimator.observer.structure.state_dict()['z_hat'][0] == feed.numbers[0]


def test_reset_keeps_counters_and_forgets_the_rest():
    feed, fresh = Feed(), Feed()
    feed.sine(100)
    feed(math.nan)
    feed.estimator.reset()
    e = feed.estimator
    assert (e.estimate, e.stamp, e.period) == (None, None, 0.0)
    fresh.count = feed.count = 7  # stamps before those of the time before
    for f in (feed, fresh):
        f.sine(50)
    assert feed.numbers == fresh.numbers
    assert feed.events == {'rejected_measurements': 1}
