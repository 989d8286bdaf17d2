# SPDX-License-Identifier: Apache-2.0
"""One estimator process with many channels: each is what an estimator for it alone would be."""

import math

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import loads
from fhaosmo_ros.core.parameters.per_channel import of_channel, with_channels
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import pytest
from running import Estimator, FED, joint_state, LATCHED, nanoseconds, OK, Rig, WARN
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

OWN = {
    'hip': {'variant': 'sign', 'lambda': [15.0]},
    'knee': {'order': 2, 'phi': ['0', '-z2']},
}
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
    assert user.call('/many/estimator/reset', Trigger, Trigger.Request()).success
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
    for name, labels in (('hip', 'z1,z2,z3'), ('knee', 'z1,z2')):
        assert rigs[name].topics['state'][-1].message.layout.dim[0].label == labels
        for task in ('input', 'observer'):
            rigs[name].wait_status(f'{name} {task}', OK)


def test_common_parameter_serves_channels_without_their_own(user, rigs):
    """What is whose is told on the topic of the parameters."""
    parameters = rigs['hip'].parameters
    told = user.record('/many/estimator/parameters', String, LATCHED)
    assert parameters.get('hip.epsilon') == 5.0
    parameters.set(epsilon=6.0, lambda_=[20.0])
    expected = {'hip.epsilon': 6.0, 'knee.epsilon': 6.0, 'hip.lambda': [15.0]}
    expected['knee.lambda'] = [20.0]
    assert parameters.all(expected) == expected
    parameters.set(**{'knee.epsilon': 7.0, 'hip.gamma_rate': 0.5})
    parameters.set(epsilon=8.0)
    user.wait(lambda: told and 'epsilon: 8.0' in told[-1].message.data, 'told change')
    values = loads(told[-1].message.data, '/many/estimator', ESTIMATOR_PARAMETERS)
    assert set(values) <= set(with_channels(ESTIMATOR_PARAMETERS, OWN))
    for channel, epsilon in (('hip', 8.0), ('knee', 7.0)):
        assert of_channel(values, channel)['epsilon'] == epsilon
        assert parameters.get(f'{channel}.epsilon') == epsilon
        assert (of_channel(values, channel)['gamma_rate'] == 0.5) == (channel == 'hip')


def test_a_common_value_that_one_channel_cannot_take_is_refused_for_all(rigs):
    parameters = rigs['hip'].parameters
    changes = {'hip.gamma_max': 0.8, 'gamma_initial': 0.9}
    names = [*changes, 'knee.gamma_initial']
    before = parameters.all(names)
    answer = parameters.try_to_set(**changes)
    assert not answer.successful
    assert "channel 'hip': parameter" in answer.reason
    assert parameters.all(names) == before


# Channels from the names of joints.


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
        """Return the estimates of a message; it is sent again until they are heard."""
        begin = self.stamp

        def answered() -> bool:
            self.send(**positions)
            return self.out and nanoseconds(self.out[-1].message.header.stamp) > begin

        self.user.wait(answered, f'estimates of {len(positions)} joints')
        return self.out[-1].message


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
    for k in range(24):
        stamp = arm.send(**{name: 0.1 * len(name) + 0.01 * k for name in orders[k % 3]})
        user.wait(
            lambda stamp=stamp: nanoseconds(arm.out[-1].message.header.stamp) == stamp, 'estimates'
        )
    estimators = {name: OnlineEstimator({'max_gap': 60.0}) for name in orders[0]}
    estimators['elbow'].configure({'epsilon': 7.0})
    expected = {
        stamp: {name: estimators[name].update(stamp, y) for name, y in positions.items()}
        for stamp, positions in arm.sent
    }
    for _, message in arm.out:
        rows = zip(message.name, message.position, message.velocity, message.effort, strict=True)
        assert {name: numbers for name, *numbers in rows} == {
            name: [*e.z[:2], e.unknown_input]
            for name, e in expected[nanoseconds(message.header.stamp)].items()
        }
    assert arm.said("expected a name that is in the message (elbow, wrist), got 'shoulder'")
    assert arm.said("parameters of 'elbo' are not used", "did you mean 'elbow'")


def test_names_that_cannot_be_are_too_many_or_come_later_are_left_out(arm):
    bad = {'a' * 300: 1.0, 'constants': 2.0, '': 3.0, 'left/wrist': 4.0}
    many = {f'j{k}': 0.1 for k in range(500)}
    arm.send(**bad, **many)
    assert arm.answer(**many).name == list(many)[:64]
    (line,) = arm.said('left out')
    assert "4 joints 'aaaa" in line
    assert "'constants', '', 'left/wrist' can't be the name of a channel" in line
    assert len(line) < 1000
    assert "left out: 436 joints 'j64', 'j65'" in line
    assert 'beyond max_channels (64)' in line
    arm.wait_status('state', WARN, "left out: 4 joints 'aaaa", "left out: 436 joints 'j64'")
    for k in range(300):
        arm.send(j0=0.1, **{f'late{k}_{i}': 0.1 for i in range(10)})
    arm.answer(j0=0.1)
    assert len(arm.said("left out: 10 joints 'late0_0'")) == 1
    assert not arm.said("joints 'late1_0'")  # said once
    arm.wait_status('state', WARN, "4 joints 'aaaa", "10 joints 'late0_0', 'late0_1'")
