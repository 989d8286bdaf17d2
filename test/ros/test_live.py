# SPDX-License-Identifier: Apache-2.0
"""Estimates and events of a running node are those of a replay."""

import itertools
import math

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.observer.estimates import TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
import numpy as np
import pytest
from running import FED, LATCHED, nanoseconds, OK, values_of, WARN
from std_msgs.msg import Float64MultiArray


def test_self_tuning_equals_a_replay_of_the_same_samples(user, estimator):
    # With a nominal period no sample is unlikely because it was sent late, and so rejected.
    values = {'gains': 'self_tuning', 'sampling': 'nominal', 'nominal_period': 0.01}
    tuning = user.record('/tuning/estimator/tuning', Float64MultiArray)
    rig = estimator('/tuning', **FED | values).listen()
    replay = OnlineEstimator({'max_gap': 60.0} | values)
    rng = np.random.default_rng(1)
    for k in range(60):
        estimate = rig.feed(0.2 + 0.1 * math.sin(0.1 * k) + 1e-3 * rng.standard_normal())
        expected = replay.update(estimate.stamp, rig.y[-1].message.data)
        for name in ('z', 'unknown_input', 'innovation'):
            np.testing.assert_array_equal(getattr(estimate, name), getattr(expected, name))
    noise, correlation, bandwidth, shares = replay.observer.tuning
    told = [noise, correlation, bandwidth, *shares]
    user.wait(lambda: tuning and list(tuning[-1].message.data) == told, 'same tuning')
    assert tuning[-1].message.layout.dim[0].label == ','.join(TUNING)


def test_on_a_timer_every_sample_counts_whichever_estimates_are_published(fed):
    fed.parameters.set(publish_on='timer', publish_rate=50.0)
    replay, expected, first = OnlineEstimator({'max_gap': 60.0}), {}, len(fed.topics['stamp'])
    for k in range(60):  # faster than the timer
        stamp = fed.send(math.sin(0.1 * k))
        expected[stamp] = list(replay.update(stamp, fed.y[-1].message.data).z)
    fed.wait_estimate(lambda e: e.stamp == stamp, 'estimate of the last sample')
    found = [e for e in fed.estimates if e.stamp in expected]
    assert [e.z for e in found] == [expected[e.stamp] for e in found]

    def at_rate() -> bool:  # the latest estimate comes again where no sample does
        periods = np.diff([message.stamp for message in fed.topics['stamp'][first:][-20:]])
        return len(periods) > 18 and np.median(periods) == pytest.approx(20e6, rel=0.2)

    fed.user.wait(at_rate, 'rate of 50 Hz')


def test_estimates_of_the_past_are_those_of_a_replay(estimator):
    values = {
        'order': 2, 'phi': ['0', '-z2'], 'noise_size': 1e-3, 'unknown_input_size': 1.0,
        'smoothing_lag': 0.05, 'max_gap': 60.0,
    }  # fmt: skip
    rig = estimator('/past', **FED | values).listen()
    ticks = itertools.count()

    def heard() -> bool:
        rig.send(0.1 * math.sin(0.1 * next(ticks)))
        return len(rig.estimates) > 40

    rig.user.wait(heard, 'estimates')
    replay = OnlineEstimator(values)
    rows = replay.run([m.stamp for m in rig.y], [m.message.data for m in rig.y])
    known = dict(zip(rows.t.tolist(), rows.unknown_input.tolist(), strict=True))
    found = [e.unknown_input for e in rig.estimates]
    assert found == [known[e.stamp] for e in rig.estimates]
    assert all(m.stamp - nanoseconds(m.message) >= 50_000_000 for m in rig.topics['stamp'])


def test_live_events_are_those_of_a_replay(user, estimator):
    values = {
        'order': 1, 'phi': ['-z1'], 'structure': 'levant', 'scheme': 'predict_correct',
        'lambda': [4.0, 5.0], 'fuzzy_widths': [0.1], 'sampling': 'nominal',
        'nominal_period': 0.01, 'max_gap': 60.0, 'event_threshold': 0.5, 'event_duration': 0.1,
    }  # fmt: skip
    rig = estimator('/events', **FED | values).listen()
    told = user.record('/events/estimator/event', DiagnosticArray, LATCHED)

    def wait_last(*words: str) -> None:
        def is_last() -> bool:
            return told and all(word in told[-1].message.status[0].message for word in words)

        user.wait(is_last, f'{words} on the topic of events')

    wait_last('no event yet')
    samples = [(rig.send(y), y) for k in range(400) for y in [1.0 if 100 <= k < 200 else 0.0]]
    replay = OnlineEstimator(values)
    replay.run(*zip(*samples, strict=True))
    events = replay.events.taken()
    assert events[0].begins
    assert len(events) >= 2
    user.wait(lambda: len(told) > len(events), 'events')
    for (_, message), event in zip(told[1:], events, strict=True):
        (status,) = message.status
        said = values_of(status)
        assert nanoseconds(message.header.stamp) == event.stamp
        assert status.level == (WARN if event.begins else OK)
        assert float(said['value']) == pytest.approx(event.value, rel=1e-8)
        assert int(said['since'].replace('.', '')) == event.since
    assert rig.said('event: unknown input')
    for _ in range(100):
        rig.send(5.0)
    rig.wait_status('observer', WARN, 'event: unknown input', 'has lasted for')
    rig.parameters.set(event_threshold=0.0)
    wait_last('events are switched off')
