# SPDX-License-Identifier: Apache-2.0
"""Estimates and events of a running node are those of a replay."""

import itertools
import math

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.observer.estimates import TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
import numpy as np
import pytest
from running import FED, LATCHED, nanoseconds, OK, WARN
from std_msgs.msg import Float64MultiArray


@pytest.mark.parametrize(
    'values',
    [
        {'publish_on': 'timer', 'publish_rate': 500.0},
        # With a nominal period no sample is unlikely because it was sent late, and so rejected.
        {'gains': 'self_tuning', 'sampling': 'nominal', 'nominal_period': 0.01},
    ],
    ids=['timer', 'self_tuning'],
)
def test_equals_a_replay_of_the_same_samples(user, estimator, values, request):
    namespace = f'/replay_{request.node.callspec.id}'
    tuning = user.record(f'{namespace}/estimator/tuning', Float64MultiArray)
    rig = estimator(namespace, **FED | values).listen()
    online = {n: v for n, v in values.items() if not n.startswith('publish')}
    replay = OnlineEstimator({'max_gap': 60.0} | online)
    rng = np.random.default_rng(1)

    def y(k: int) -> float:
        return 0.2 + 0.1 * math.sin(0.1 * k) + 1e-3 * rng.standard_normal()

    names = ['z', 'unknown_input', 'innovation', *(['gamma'] if 'gamma' in rig.topics else [])]
    for k in range(60):
        estimate = rig.feed(y(k))
        expected = replay.update(estimate.stamp, rig.y[-1].message.data)
        for name in names:
            np.testing.assert_array_equal(getattr(estimate, name), getattr(expected, name))
    # A burst, faster than any timer: every sample counts, whichever estimates are published.
    burst = [rig.send(y(k)) for k in range(60, 120)]
    samples = {m.stamp: m.message.data for m in rig.y}
    expected = {stamp: replay.update(stamp, samples[stamp]) for stamp in burst}
    rig.wait_estimate(lambda e: e.stamp == burst[-1], 'estimate of the last sample')
    for e in rig.estimates:
        if e.stamp in expected:
            np.testing.assert_array_equal(e.z, expected[e.stamp].z)
    innovation = rig.topics['innovation'][-1].message
    assert innovation.layout.dim[0].label.startswith('eps1,eps2,eps3,eps4')
    if 'gains' in values:
        noise, correlation, bandwidth, shares = replay.observer.tuning
        assert bandwidth > 0.0
        told = [noise, correlation, bandwidth, *shares]
        user.wait(lambda: tuning and list(tuning[-1].message.data) == told, 'same tuning')
        assert tuning[-1].message.layout.dim[0].label == ','.join(TUNING)


def test_estimates_of_the_past_are_those_of_a_replay(estimator):
    values = {
        'order': 2, 'phi': ['0', '-z2'], 'noise_size': 1e-3, 'unknown_input_size': 1.0,
        'smoothing_lag': 0.05, 'max_gap': 60.0,
    }  # fmt: skip
    rig = estimator('/past', **FED | values)
    rig.listen()
    ticks = itertools.count()

    def heard() -> bool:
        rig.send(0.1 * math.sin(0.1 * next(ticks)))
        return len(rig.estimates) > 40

    rig.user.wait(heard, 'estimates')
    replay = OnlineEstimator(values)
    rows = replay.run([m.stamp for m in rig.y], [m.message.data for m in rig.y])
    known = dict(zip(rows.t.tolist(), rows.unknown_input.tolist(), strict=True))
    for e in rig.estimates:
        assert e.unknown_input == known[e.stamp]
    for published, stamp in rig.topics['stamp']:
        assert published - nanoseconds(stamp) >= 50_000_000


# Events.


def told_events(published) -> list:
    """Return level, stamp and values of messages on ~/event."""
    found = []
    for message in (p.message for p in published):
        (status,) = message.status
        values = {pair.key: pair.value for pair in status.values}
        found.append((status.level, nanoseconds(message.header.stamp), values))
    return [entry for entry in found if entry[2]]


def test_live_events_are_those_of_a_replay(user, estimator):
    values = {
        'order': 1, 'phi': ['-z1'], 'structure': 'levant', 'scheme': 'predict_correct',
        'lambda': [4.0, 5.0], 'fuzzy_widths': [0.1], 'sampling': 'nominal',
        'nominal_period': 0.01, 'max_gap': 60.0, 'event_threshold': 0.5, 'event_duration': 0.1,
    }  # fmt: skip
    rig = estimator('/events', **FED | values)
    early = user.record('/events/estimator/event', DiagnosticArray, LATCHED)
    user.wait(lambda: early, 'the state before any event')
    assert early[0].message.status[0].message == 'no event yet'
    rig.listen()
    samples = [(rig.send(y), y) for k in range(400) for y in [1.0 if 100 <= k < 200 else 0.0]]
    replay = OnlineEstimator(values)
    replay.run(*zip(*samples, strict=True))
    events = replay.events.taken()
    assert events[0].begins
    assert len(events) >= 2
    user.wait(lambda: len(told_events(early)) >= len(events), 'events')
    for (level, stamp, told), event in zip(told_events(early), events, strict=True):
        assert (level, stamp) == (WARN if event.begins else OK, event.stamp)
        assert float(told['value']) == pytest.approx(event.value, rel=1e-8)
        assert int(told['since'].replace('.', '')) == event.since
    late = user.record('/events/estimator/event', DiagnosticArray, LATCHED)
    user.wait(
        lambda: told_events(late) and told_events(late)[-1] == told_events(early)[-1],
        'latest event',
    )
    assert rig.said('event: unknown input')
    for _ in range(100):
        rig.send(5.0)
    rig.wait_status('observer', WARN, 'event: unknown input', 'has lasted for')
    rig.parameters.set(event_threshold=0.0)
    user.wait(
        lambda: early[-1].message.status[0].message == 'events are switched off', 'switched off'
    )
