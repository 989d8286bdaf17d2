# SPDX-License-Identifier: Apache-2.0
"""One estimator process with many channels: each is what an estimator for it alone would be."""

import math

from fhaosmo_ros.core.online.estimator import OnlineEstimator
import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rig import Parameters, Process  # noqa: E402
from std_msgs.msg import Float64, Float64MultiArray  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

FILE = """
/**:
  ros__parameters:
    channels: [hip, knee]
    publish_rate: 200.0
    max_gap: 60.0
    epsilon: 5.0
    hip:
      variant: sign
      lambda: [15.0]
    knee:
      order: 2
      phi: ['0', '-z2']
"""
COMMON = {'max_gap': 60.0, 'epsilon': 5.0}
OWN = {
    'hip': {'variant': 'sign', 'lambda': [15.0]},
    'knee': {'order': 2, 'phi': ['0', '-z2']},
}
NODE = '/many/estimator'


@pytest.fixture(scope='module', name='parameters')
def _parameters(start, folder, client):
    path = folder() / 'many.yaml'
    path.write_text(FILE)
    start('estimator', '--ros-args', '-r', '__ns:=/many', '--params-file', path)
    return Parameters(client, NODE)


class Joint:
    """One channel, fed and heard."""

    def __init__(self, client, name):
        self.client = client
        self.sent = client.record(f'/many/{name}/y', Float64)
        self.state = client.record(f'{NODE}/{name}/state', Float64MultiArray)
        self.stamps = client.record(f'{NODE}/{name}/stamp', Time)
        self.publish = client.publisher(f'/many/{name}/y')
        client.wait(lambda: self.publish.matched() >= 2, f'subscription of {name}/y')
        client.wait(lambda: client.node.count_publishers(f'{NODE}/{name}/stamp'), 'estimator')

    def newest(self):
        """Return the sample behind the latest estimate, in nanoseconds."""
        stamp = self.stamps[-1].message if self.stamps else Time()
        return stamp.sec * 10**9 + stamp.nanosec

    def has_answered(self):
        return len(self.sent) > 0 and self.newest() == self.sent[-1].stamp


@pytest.fixture(scope='module', name='joints')
def _joints(parameters, client):
    joints = {name: Joint(client, name) for name in OWN}
    for joint in joints.values():

        def greeted(joint=joint):
            joint.publish(0.0)
            return joint.stamps

        client.wait(greeted, 'first estimate')
    return joints


def test_each_channel_is_bit_for_bit_an_estimator_of_its_own(joints, client, parameters):
    """Also after a common parameter has changed, which serves knee only: hip has its own."""
    answered(client, joints)
    client.call(f'{NODE}/reset', Trigger, Trigger.Request())
    estimators = {name: OnlineEstimator(COMMON | own) for name, own in OWN.items()}
    for part in range(2):
        begin = {name: len(joint.sent) for name, joint in joints.items()}
        for k in range(30):
            for name, joint in joints.items():
                y = math.nan if (k, name) == (10, 'hip') else math.sin(0.1 * k) + part + len(name)
                joint.publish(y)
        client.wait(
            lambda b=begin: all(len(j.sent) == b[n] + 30 for n, j in joints.items()), 'samples'
        )
        answered(client, joints)
        for name, joint in joints.items():
            for stamp, message in joint.sent[begin[name] :]:
                estimate = estimators[name].update(stamp, message.data)
            np.testing.assert_array_equal(list(joint.state[-1].message.data), estimate.z)
        assert parameters.set_atomically(lambda_=[20.0]).successful
        estimators['knee'].configure({'lambda': [20.0]})


def answered(client, joints):
    """Wait until the latest sample of each channel is in an estimate that has come whole."""
    for joint in joints.values():
        client.wait(joint.has_answered, 'estimate of the last sample')
        published = joint.stamps[-1].stamp
        client.wait(lambda j=joint, p=published: j.stamps[-1].stamp > p, 'estimate after it')
        client.wait(lambda j=joint, p=published: j.state[-1].stamp > p, 'state after it')


def test_labels_and_sizes_are_each_channels_own(joints):
    labels = {n: joint.state[-1].message.layout.dim[0].label for n, joint in joints.items()}
    assert labels == {'hip': 'z1,z2,z3', 'knee': 'z1,z2'}


def test_common_parameter_serves_channels_without_their_own(parameters):
    assert parameters.get('hip.epsilon') == 5.0
    assert parameters.set_atomically(epsilon=6.0).successful
    assert [parameters.get(f'{name}.epsilon') for name in OWN] == [6.0, 6.0]
    assert parameters.set_atomically(lambda_=[20.0]).successful
    assert parameters.get('hip.lambda') == [15.0]
    assert parameters.get('knee.lambda') == [20.0]
    assert parameters.set_atomically(**{'knee.epsilon': 7.0}).successful
    assert parameters.set_atomically(epsilon=8.0).successful
    assert [parameters.get(f'{name}.epsilon') for name in OWN] == [8.0, 7.0]


def test_bad_set_names_the_channel_and_changes_nothing(parameters):
    answer = parameters.set_atomically(**{'knee.gamma_min': 0.9, 'knee.gamma_max': 0.2})
    assert not answer.successful
    assert "channel 'knee'" in answer.reason
    assert 'expected each at most the next one, got 0.9' in answer.reason
    assert parameters.get('knee.gamma_max') == 1.0


def test_followers_are_checked_with_what_they_follow(parameters):
    """A common value that one of its followers can't take is refused for all."""
    assert parameters.set_atomically(**{'hip.gamma_max': 0.8}).successful
    answer = parameters.set_atomically(gamma_initial=0.9)
    assert not answer.successful
    assert "channel 'hip'" in answer.reason
    assert parameters.get('knee.gamma_initial') == parameters.get('gamma_initial') == 0.67


def test_reports_and_services_of_each(joints, client):
    reports = client.record('/diagnostics', DiagnosticArray)
    names = {f'many/estimator: {n} {t}' for n in OWN for t in ('input', 'observer')}
    client.wait(
        lambda: reports and names <= {s.name for s in reports[-1].message.status}, 'report'
    )
    for name in OWN:
        assert client.call(f'{NODE}/{name}/reset', Trigger, Trigger.Request()).success


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (
            ['channels:=[hip]', 'hpi.epsilon:=3.0'],
            "unknown parameter 'hpi.epsilon'; did you mean 'hip.epsilon'?",
        ),
        (['channels:=[hip, hip]'], "parameter 'channels': expected every name once"),
        (['channels:=[hip]', 'hip.epsilon:=-1.0'], "'hip.epsilon': expected a number > 0"),
        (
            ['channels:=[hip]', 'hip.order:=2'],
            "channel 'hip': parameter 'phi': expected 2 expressions",
        ),
        (['hip.epsilon:=3.0'], "unknown parameter 'hip.epsilon'"),
    ],
)
def test_bad_channels_end_the_node_in_one_line(folder, words, message):
    arguments = [part for word in words for part in ('-p', word)]
    process = Process(folder(), 'estimator', '--ros-args', *arguments)
    try:
        assert process.wait(60.0) == 2
    finally:
        process.kill()
    assert message in process.output
    assert 'Traceback' not in process.output
