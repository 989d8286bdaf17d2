# SPDX-License-Identifier: Apache-2.0
"""~/event: the events that a replay finds, told live; a late subscriber gets the latest one."""

from fhaosmo_ros.core.online.estimator import OnlineEstimator
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from rig import EstimatorRig, Parameters, parameters  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
VALUES = {
    'order': 1, 'phi': ['-z1'], 'structure': 'levant', 'scheme': 'predict_correct',
    'lambda': [4.0, 5.0], 'fuzzy_widths': [0.1], 'sampling': 'nominal', 'nominal_period': 0.01,
    'max_gap': 60.0, 'event_threshold': 0.5, 'event_duration': 0.1,
}  # fmt: skip


def numbers(published):
    """Return level, stamp and values of messages on ~/event."""
    found = []
    for message in (p.message for p in published):
        (status,) = message.status
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        found.append((status.level, stamp, {pair.key: pair.value for pair in status.values}))
    return [entry for entry in found if entry[2]]


@pytest.mark.parametrize('channel', ['', 'hip'])
def test_live_events_are_those_of_a_replay(channel, client, start):
    namespace, part = f'/events{channel}', f'{channel}/' if channel else ''
    process = start('estimator', *parameters(**VALUES, namespace=namespace, channels=[channel]))
    node = f'{namespace}/estimator/{part}'
    sent = client.record(f'{namespace}/{part}y', Float64)
    early = client.record(f'{node}event', DiagnosticArray, LATCHED)
    inputs = client.record(f'{node}unknown_input', Float64)
    publish = client.publisher(f'{namespace}/{part}y')
    client.wait(lambda: publish.matched() >= 2, 'subscription of y')
    client.wait(lambda: early, 'the state before any event')
    assert early[0].message.status[0].message == 'no event yet'

    def feed(y):
        count = len(sent)
        publish(y)
        client.wait(lambda: len(sent) > count, 'own sample')
        return len(inputs) > 0

    client.wait(lambda: feed(0.0), 'first estimate')
    assert client.call(f'{node}reset', Trigger, Trigger.Request()).success
    first = len(sent)
    for k in range(400):
        feed(1.0 if 100 <= k < 200 else 0.0)
    estimator = OnlineEstimator(VALUES)
    estimator.run([s.stamp for s in sent[first:]], [s.message.data for s in sent[first:]])
    events = estimator.events.taken()
    assert events[0].begins
    assert len(events) >= 2
    client.wait(lambda: len(numbers(early)) >= len(events), 'events')
    levels = [DiagnosticStatus.OK, DiagnosticStatus.WARN]
    for (level, stamp, values), event in zip(numbers(early), events, strict=True):
        assert (level, stamp) == (levels[event.begins], event.stamp)
        assert float(values['value']) == pytest.approx(event.value, rel=1e-8)
        assert int(values['since'].replace('.', '')) == event.since
    late = client.record(f'{node}event', DiagnosticArray, LATCHED)
    client.wait(lambda: numbers(late) and numbers(late)[-1] == numbers(early)[-1], 'latest event')
    assert 'event: unknown input' in process.output
    (result,) = Parameters(client, f'{namespace}/estimator').set(event_threshold=0.0)
    assert result.successful, result.reason
    client.wait(
        lambda: early[-1].message.status[0].message == 'events are switched off', 'switched off'
    )


def test_deviations_of_fixed_gains_are_refused_with_the_reason(client, start):
    start('estimator', *parameters(namespace='/refused'))
    (result,) = Parameters(client, '/refused/estimator').set(event_deviations=4.0)
    assert not result.successful
    assert "expected gains = 'self_tuning'" in result.reason


def test_an_event_is_reported_while_it_lasts(client, start):
    start('estimator', *parameters(**VALUES, namespace='/lasts'))
    rig = EstimatorRig(client, '/lasts')
    for _ in range(100):
        rig.send(5.0)
    rig.wait_status('observer', DiagnosticStatus.WARN, 'event: unknown input', 'has lasted for')
