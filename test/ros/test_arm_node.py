# SPDX-License-Identifier: Apache-2.0
"""The arm node over the middleware: who it waits for, what it publishes, what it cannot use."""

import numpy as np
import pytest

pytest.importorskip('pinocchio')

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.arm.model import ArmModel
from geometry_msgs.msg import WrenchStamped
from robots import JOINTS, motion, URDF
from running import as_time, ERROR, LATCHED, nanoseconds, OK, Parameters, Rig, WARN
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

MIXED = ['wheel', 'elbow', 'turn', 'shoulder']
ORDER = [JOINTS.index(name) for name in MIXED[1:]]
MOTION = motion(ArmModel(URDF), 1e-3 * np.arange(6000))
FIELDS = {'external_torque': 'effort', 'joint_states': 'velocity', 'standard_deviation': 'effort'}


class Limb(Rig):
    """A running arm node that is sent a motion, and what it publishes."""

    def __init__(self, user, process, namespace):
        super().__init__(user, process, f'{namespace}/arm')
        self.heard = {topic: user.record(f'{self.name}/{topic}', JointState) for topic in FIELDS}
        self.torques = self.heard['external_torque']
        self.samples = user.publisher(f'{namespace}/joint_states', JointState)
        self.stamp, self.sent = 10**12, []

    def send(self, k, push=0.0, names=MIXED, **changes):
        """Send the k-th sample of the motion, a millisecond after the one before."""
        self.stamp += 1_000_000
        q, effort = MOTION[1][k], MOTION[3][k] - push
        self.sent.append((self.stamp, q, effort))
        fields = {'position': [9.0, *q[ORDER]], 'effort': [9.0, *effort[ORDER]]} | changes
        header = Header(stamp=as_time(self.stamp))
        self.samples.publish(JointState(header=header, name=names, **fields))

    def is_answered(self) -> bool:
        last = self.torques[-1].message.header.stamp if self.torques else as_time(0)
        return nanoseconds(last) == self.stamp

    def estimate(self, samples, push=0.0):
        """Send samples, each after the estimate of the one before; return the last torques."""
        for k in samples:
            self.send(k, push)
            self.user.wait(self.is_answered, f'estimate of sample {k}')
        return np.array(self.torques[-1].message.effort)


@pytest.fixture(scope='module')
def limb(launch, user):
    """Return an arm node that has heard its robot's description, and everything around it."""
    options = {'wrench_frame': 'tool', 'publish_rate': 5000.0}
    limb = Limb(user, launch('arm', namespace='/limb', **options), '/limb')
    limb.wrenches = user.record(f'{limb.name}/external_wrench', WrenchStamped)
    limb.events = user.record(f'{limb.name}/event', DiagnosticArray, LATCHED)
    limb.description = user.publisher('/limb/robot_description', String, qos=LATCHED)
    limb.wait_said('waiting for the robot on /limb/robot_description')
    limb.wait_status('arm', ERROR, 'no robot yet')
    limb.description.publish(String(data='rubbish'))
    limb.wait_said('robot description: expected a URDF, got')
    limb.description.publish(String(data=URDF))
    limb.wait_said('estimating the external torques of turn, shoulder, elbow')
    # Estimates are lost until the node's publishers have found who listens.
    user.wait(lambda: all(limb.heard.values()) or limb.send(0), 'first estimates')
    limb.estimate(range(1, 500))
    return limb


def test_node_and_library_agree_on_the_same_samples(limb, user):
    arm = Arm(URDF)
    expected = {sample[0]: arm.take(*sample) for sample in limb.sent}
    for topic, field in FIELDS.items():
        messages, part = limb.heard[topic], 'velocity' if field == 'velocity' else topic
        user.wait(lambda messages=messages: len(messages) >= 499, f'{topic} of each sample')
        for _, message in messages:
            of_sample = getattr(expected[nanoseconds(message.header.stamp)], part)
            np.testing.assert_array_equal(getattr(message, field), of_sample)
            assert message.name == list(JOINTS)


def test_a_contact_is_an_event_with_its_link_and_ends(limb, user):
    begun = len(limb.events)
    limb.estimate(range(500, 700), np.array([0.0, -6.0, -5.0]))
    user.wait(lambda: len(limb.events) > begun, 'event')
    status = limb.events[begun].message.status[0]
    assert (status.level, status.name) == (WARN, 'limb/arm: contact')
    assert status.message in (f'contact, most likely at {link}' for link in ('upper', 'lower'))
    assert limb.wrenches[-1].message.header.frame_id == 'tool'
    limb.estimate(range(700, 1000))
    user.wait(lambda: limb.events[-1].message.status[0].level == OK, 'end of the contact')


@pytest.mark.parametrize(('changes', 'text'), [
    ({'names': ['wheel', 'elbo', *MIXED[2:]]}, "a message lacks elbow; did you mean 'elbo'?"),
    ({'effort': []}, 'effort: expected 4 numbers, one for each name, got 0'),
    ({'effort': [0.0, np.nan, 0.0, 0.0]}, 'are NaN or infinite'),
    ({'position': [0.0, 20.0, 60.0, 45.0]}, 'are they in degrees'),
    ({'position': [0.0, 2.0, 2.0, 2.0]}, 'jumped faster than three times'),
    ({'effort': [0.0, 1e300, 0.0, 0.0]}, 'what is the unit of effort?'),
    ({'stamp': 0}, 'the header stamp is 0'),
    ({'stamp': 10**11}, 'older than before: the estimates began anew'),
])  # fmt: skip
def test_what_cannot_be_used_is_said_once_and_survived(limb, changes, text):
    published, stamp = len(limb.torques), limb.stamp
    fields = {name: value for name, value in changes.items() if name != 'stamp'}
    for _ in range(2):
        limb.stamp = changes.get('stamp', limb.stamp + 1_000_000) - 1_000_000
        limb.send(1100, **fields)
    limb.wait_said(text)
    assert len(limb.torques) == published
    limb.stamp = stamp + 200_000_000  # begin anew
    limb.send(1101)
    assert np.abs(limb.estimate(range(1102, 1200))).max() < 1.0
    assert len(limb.said(text)) == 1


def test_tare_payload_and_a_second_robot(limb, user):
    limb.description.publish(String(data=URDF.replace('three', 'other')))
    limb.wait_said('a second robot on /limb/robot_description is ignored')
    limb.estimate(range(1202, 1500), 2.0)
    assert user.call(f'{limb.name}/tare', Trigger).success
    for samples in (range(1500, 1501), range(1501, 1700)):  # at once, and later
        assert np.abs(limb.estimate(samples, 2.0)).max() < 0.5
    parameters = Parameters(user, limb.name)
    assert 'mass >= 0' in parameters.try_to_set(payload=[-1.0, 0.0, 0.0, 0.0]).reason
    assert not parameters.try_to_set(effort='current').successful
    parameters.set(payload=[1.0, 0.0, 0.0, 0.4])
    found = limb.estimate(range(1700, 1900), 2.0)
    weight = -9.81 * np.sin(MOTION[1][1899][1:].cumsum()) @ [[0.4, 0.0], [0.4, 0.4]]
    np.testing.assert_allclose(found, [0.0, *weight], atol=0.3 * np.abs(weight).max())
    assert user.call(f'{limb.name}/reset', Trigger).success


def test_a_robot_of_a_file_and_a_wrong_setting_which_stops_the_estimates(launch, user, tmp_path):
    urdf = tmp_path / 'three.urdf'
    urdf.write_text(URDF)
    process = launch('arm', namespace='/wrong', robot_description_file=urdf, publish_rate=5000.0)
    limb, text = Limb(user, process, '/wrong'), 'the efforts of all joints have the wrong sign'
    user.wait(lambda: limb.torques or limb.send(0, 2.0 * MOTION[3][0]), 'first estimate')
    for k in range(1, len(MOTION[0])):
        limb.send(k, 2.0 * MOTION[3][k])
        user.wait(lambda: limb.said(text) or limb.is_answered(), f'estimate {k}')
        if not limb.is_answered():
            break
    silence = 'no usable sample on /wrong/joint_states for'
    limb.wait_status('arm', ERROR, text, silence, doing=lambda: limb.send(k, 2.0 * MOTION[3][k]))
    assert not limb.is_answered()
