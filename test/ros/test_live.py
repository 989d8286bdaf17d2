# SPDX-License-Identifier: Apache-2.0
"""Estimates and events of a running node, of one channel or many, are those of a replay."""

import itertools
import math

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.observer.estimates import TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import loads
from fhaosmo_ros.core.parameters.per_channel import of_channel
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import numpy as np
import pytest
from running import Estimator, FED, joint_state, LATCHED, nanoseconds, OK, Rig, values_of, WARN
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

# With a nominal period no sample is unlikely because it was sent late, and so rejected.
TUNED = {'gains': 'self_tuning', 'sampling': 'nominal', 'nominal_period': 0.01, 'max_gap': 60.0}
SMOOTHED = {
    'order': 2, 'phi': ['0', '-z2'], 'noise_size': 1e-3, 'unknown_input_size': 1.0,
    'smoothing_lag': 0.05, 'max_gap': 60.0,
}  # fmt: skip


@pytest.mark.parametrize('values', [TUNED, SMOOTHED], ids=['tuned', 'smoothed'])
def test_estimates_are_those_of_a_replay_of_the_same_samples(user, estimator, values):
    space = f'/replayed_{len(values)}'
    tuning = user.record(f'{space}/estimator/tuning', Float64MultiArray)
    rig, ticks = estimator(space, **FED | values).listen(), itertools.count()

    def heard() -> bool:
        rig.send(0.2 + 0.1 * math.sin(0.1 * next(ticks)))
        return len(rig.estimates) > 60

    user.wait(heard, 'estimates')
    replay = OnlineEstimator(values)
    rows = replay.run([m.stamp for m in rig.y], [m.message.data for m in rig.y])
    columns = (column.tolist() for column in (rows.z, rows.unknown_input, rows.innovation))
    known = dict(zip(rows.t.tolist(), zip(*columns, strict=True), strict=True))
    for e in rig.estimates:
        assert (e.z, e.unknown_input, e.innovation) == known[e.stamp]
    if values is SMOOTHED:
        assert all(m.stamp - nanoseconds(m.message) >= 50_000_000 for m in rig.topics['stamp'])
        return
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


def test_live_events_are_those_of_a_replay(user, estimator):
    values = {
        'order': 1, 'phi': ['-z1'], 'structure': 'levant', 'scheme': 'predict_correct',
        'lambda': [4.0, 5.0], 'fuzzy_widths': [0.1], 'sampling': 'nominal',
        'nominal_period': 0.01, 'max_gap': 60.0, 'event_threshold': 0.5, 'event_duration': 0.1,
    }  # fmt: skip
    rig = estimator('/events', **FED | values).listen()
    told = user.record('/events/estimator/event', DiagnosticArray, LATCHED)
    user.wait(lambda: told, 'that there is no event yet')
    assert told[0].message.status[0].message == 'no event yet'
    samples = [(rig.send(y), y) for k in range(400) for y in [1.0 if 100 <= k < 200 else 0.0]]
    replay = OnlineEstimator(values)
    replay.run(*zip(*samples, strict=True))
    events = replay.events.taken()
    assert events[0].begins
    assert len(events) >= 2
    user.wait(lambda: len(told) > len(events), 'events')
    for (_, message), event in zip(told[1:], events, strict=True):
        said = values_of(message.status[0])
        assert nanoseconds(message.header.stamp) == event.stamp
        assert said['level'] == (WARN if event.begins else OK)
        assert float(said['value']) == pytest.approx(event.value, rel=1e-8)
        assert int(said['since'].replace('.', '')) == event.since
    assert rig.said('event: unknown input')


OWN = {'hip': {'variant': 'sign', 'lambda': [15.0]}, 'knee': {'order': 2, 'phi': ['0', '-z2']}}
COMMON = {'max_gap': 60.0, 'epsilon': 5.0}


@pytest.fixture(scope='module')
def rigs(user, launch):
    """Return what belongs to each channel, by its name."""
    own = {f'{name}.{key}': value for name, values in OWN.items() for key, value in values.items()}
    common = FED | COMMON | {'channels': list(OWN)}
    reliable = [f'{name}/y' for name in OWN]
    process = launch('estimator', namespace='/many', reliable=reliable, **common, **own)
    return {name: Estimator(user, process, '/many', name).listen() for name in OWN}


def test_each_channel_is_bit_for_bit_an_estimator_of_its_own(user, rigs):
    """Also where hip alone is reset, and a common parameter changes that serves only knee."""
    assert user.call('/many/estimator/reset', Trigger).success
    estimators = {name: OnlineEstimator(COMMON | own) for name, own in OWN.items()}
    for k in range(50):
        if k == 25:
            rigs['hip'].parameters.set(lambda_=[20.0])
            estimators['knee'].configure({'lambda': [20.0]})
            assert rigs['hip'].reset().success
            estimators['hip'].reset()
        for name, rig in rigs.items():
            if (k, name) == (10, 'hip'):
                estimators[name].update(rig.send(math.nan), math.nan)
                continue
            found = rig.feed(math.sin(0.1 * k) + len(name))
            expected = estimators[name].update(found.stamp, rig.y[-1].message.data)
            assert found.z == list(expected.z)
            assert found.unknown_input == expected.unknown_input
    assert rigs['knee'].topics['state'][-1].message.layout.dim[0].label == 'z1,z2'
    rigs['knee'].wait_status('knee observer', OK)


def test_common_parameter_serves_channels_without_their_own(user, rigs):
    """What is whose is told on the topic of the parameters."""
    parameters = rigs['hip'].parameters
    told = user.record('/many/estimator/parameters', String, LATCHED)
    assert parameters.get('hip.epsilon') == 5.0
    parameters.set(epsilon=6.0, lambda_=[20.0])
    expected = {'hip.epsilon': 6.0, 'knee.epsilon': 6.0, 'hip.lambda': [15.0]}
    expected['knee.lambda'] = [20.0]
    assert parameters.all(expected) == expected
    parameters.set(**{'knee.epsilon': 7.0})
    parameters.set(epsilon=8.0)
    user.wait(lambda: told and 'epsilon: 8.0' in told[-1].message.data, 'told change')
    values = loads(told[-1].message.data, '/many/estimator', ESTIMATOR_PARAMETERS)
    for channel, epsilon in (('hip', 8.0), ('knee', 7.0)):
        assert of_channel(values, channel)['epsilon'] == epsilon
        assert parameters.get(f'{channel}.epsilon') == epsilon
    # What one channel cannot take is refused for all.
    changes = {'hip.gamma_min': 0.8, 'gamma_initial': 0.7}
    before = parameters.all([*changes, 'knee.gamma_initial'])
    assert "channel 'hip': parameter" in parameters.try_to_set(**changes).reason
    assert parameters.all(before) == before


def stamp_of(message: JointState) -> int:
    return nanoseconds(message.header.stamp)


class Arm(Rig):
    """An estimator of whatever joints come, fed and heard."""

    def __init__(self, user, process, namespace):
        super().__init__(user, process, f'{namespace}/estimator')
        self.publisher = user.publisher(f'{namespace}/joint_states', JointState)
        self.out = user.record(f'{self.name}/joint_states', JointState)
        self.stamp, self.sent = 10**9, []

    def send(self, **positions) -> int:
        self.stamp += 2_000_000
        self.publisher.publish(joint_state(self.stamp, positions, positions.values()))
        self.sent.append((self.stamp, positions))
        return self.stamp

    def answer(self, **positions):
        """Return the estimates of a message, which is sent again and again until they come."""
        begin, out = self.stamp, self.out
        self.user.wait(
            lambda: self.send(**positions) and out and stamp_of(out[-1].message) > begin,
            f'estimates of {len(positions)} joints',
        )
        self.user.wait(lambda: stamp_of(out[-1].message) == self.stamp, 'those of the last one')
        return out[-1].message


@pytest.fixture
def arm(user, launch, request):
    namespace = f'/{request.node.name}'
    own = ['-p', 'elbow.epsilon:=7.0', '-p', 'elbo.epsilon:=7.0']
    channels = FED | {'channels': ['from_joint_names'], 'reliable': ['joint_states']}
    return Arm(user, launch('estimator', *own, namespace=namespace, **channels), namespace)


def test_each_joint_is_a_channel_whatever_the_order_of_the_names(user, arm):
    arm.wait_said('waiting for the first message')
    orders = [('shoulder', 'elbow', 'wrist'), ('wrist', 'shoulder', 'elbow'), ('elbow', 'wrist')]
    arm.answer(shoulder=0.1, elbow=0.2, wrist=0.3)
    assert user.call(f'{arm.name}/reset', Trigger).success
    del arm.sent[:], arm.out[:]
    for k in range(24):
        stamp = arm.send(**{name: 0.1 * len(name) + 0.01 * k for name in orders[k % 3]})
        user.wait(lambda at=stamp: arm.out and stamp_of(arm.out[-1].message) == at, 'estimates')
    estimators = {name: OnlineEstimator({'max_gap': 60.0}) for name in orders[0]}
    estimators['elbow'].configure({'epsilon': 7.0})
    expected = {
        stamp: {name: estimators[name].update(stamp, y) for name, y in positions.items()}
        for stamp, positions in arm.sent
    }
    for _, message in arm.out:
        rows = zip(message.name, message.position, message.velocity, message.effort, strict=True)
        assert {name: numbers for name, *numbers in rows} == {
            name: [*e.z[:2], e.unknown_input] for name, e in expected[stamp_of(message)].items()
        }
    arm.wait_count('messages without y', 8)
    assert arm.said("parameters of 'elbo' are not used")


def test_names_that_cannot_be_are_too_many_or_come_later_are_left_out(arm):
    bad = {'a' * 300: 1.0, 'constants': 2.0, '': 3.0, 'left/wrist': 4.0}
    many = {f'j{k}': 0.1 for k in range(500)}
    arm.send(**bad, **many)
    assert arm.answer(**many).name == list(many)[:64]
    (line,) = arm.said('440 joints are no channels', 'more than max_channels (64)')
    assert "'constants', '', 'left/wrist', 'j64', 'j65'" in line
    assert len(line) < 1000
    for k in range(300):
        arm.send(j0=0.1, **{f'late{k}_{i}': 0.1 for i in range(10)})
    assert arm.answer(j0=0.1).name == ['j0']
