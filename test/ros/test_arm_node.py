# SPDX-License-Identifier: Apache-2.0
"""The arm node over the middleware: who it waits for, what it publishes, what it cannot use."""

from pathlib import Path
import sys
import time

import numpy as np
import pytest

pytest.importorskip('pinocchio')
sys.path.insert(0, str(Path(__file__).parents[1] / 'arm'))

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
PUSH = np.array([0.0, -6.0, -5.0])
MOTION = motion(ArmModel(URDF), 6.0)
TORQUE = 'external_torque'
KINDS = {
    TORQUE: JointState, 'standard_deviation': JointState, 'joint_states': JointState,
    'external_wrench': WrenchStamped,
}  # fmt: skip


class Limb(Rig):
    """A running arm node that is sent a motion, and what it publishes."""

    def __init__(self, user, process, namespace):
        super().__init__(user, process, f'{namespace}/arm')
        self.heard = {name: user.record(f'{self.name}/{name}', KINDS[name]) for name in KINDS}
        self.events = user.record(f'{self.name}/event', DiagnosticArray, LATCHED)
        self.samples = user.publisher(f'{namespace}/joint_states', JointState)
        self.stamp, self.sent = 10**12, []

    def send(self, k, push=0.0, names=MIXED, **changes):
        """Send the k-th sample of the motion, a millisecond after the one before."""
        self.stamp += 1_000_000
        fields = {'position': MOTION[1][k], 'effort': MOTION[3][k] - push}
        self.sent.append((self.stamp, *fields.values()))
        order = [JOINTS.index(name) for name in MIXED[1:]]
        fields = {name: [9.0, *values[order].tolist()] for name, values in fields.items()}
        header = Header(stamp=as_time(self.stamp))
        self.samples.publish(JointState(header=header, name=names, **fields | changes))

    def is_answered(self) -> bool:
        heard = self.heard[TORQUE]
        return heard and nanoseconds(heard[-1].message.header.stamp) == self.stamp

    def estimate(self, samples, **options):
        """Send samples, each after the estimate of the one before; return the last estimate."""
        for k in samples:
            self.send(k, **options)
            self.user.wait(self.is_answered, f'estimate of sample {k}')
        return self.heard[TORQUE][-1].message


@pytest.fixture(scope='module')
def limb(launch, user):
    """Return an arm node that has heard its robot's description, and everything around it."""
    process = launch(
        'arm', namespace='/limb', wrench_frame='tool', publish_rate=5000.0, diagnostics_period=0.2
    )
    limb = Limb(user, process, '/limb')
    limb.description = user.publisher('/limb/robot_description', String, qos=LATCHED)
    limb.wait_said('waiting for the robot on /limb/robot_description')
    limb.wait_status('arm', ERROR, 'no robot yet')
    limb.description.publish(String(data='rubbish'))
    limb.wait_said('robot description: expected the XML of a URDF')
    limb.description.publish(String(data=URDF))
    limb.wait_said('estimating the external torques of turn, shoulder, elbow')
    # Estimates are lost until the node's publishers have found who listens.
    user.wait(lambda: all(limb.heard.values()) or limb.send(0), 'first estimates')
    limb.estimate(range(1, 500))
    return limb


def test_node_and_library_agree_on_the_same_samples(limb, user):
    arm = Arm(URDF)
    found = [arm.take(*sample) for sample in limb.sent]
    expected = {e.stamp: e for e in found if e is not None}
    for name, part, field in (
        (TORQUE, 'external_torque', 'effort'), ('joint_states', 'velocity', 'velocity'),
        ('standard_deviation', 'standard_deviation', 'effort'),
    ):  # fmt: skip
        user.wait(lambda name=name: len(limb.heard[name]) >= 499, f'{name} of each sample')
        for _, message in limb.heard[name]:
            e = expected[nanoseconds(message.header.stamp)]
            assert message.name == list(JOINTS)
            np.testing.assert_array_equal(getattr(message, field), getattr(e, part))


def test_a_contact_is_an_event_with_its_link_and_ends(limb, user):
    begun = len(limb.events)
    message = limb.estimate(range(500, 700), push=PUSH)
    np.testing.assert_allclose(message.effort, PUSH, atol=1.5)
    user.wait(lambda: len(limb.events) > begun, 'event')
    status = limb.events[begun].message.status[0]
    assert (status.level, status.name) == (WARN, 'limb/arm: contact')
    assert status.message in (f'contact, most likely at {link}' for link in ('upper', 'lower'))
    assert limb.heard['external_wrench'][-1].message.header.frame_id == 'tool'
    limb.estimate(range(700, 1000))
    user.wait(lambda: limb.events[-1].message.status[0].level == OK, 'end of the contact')


@pytest.mark.parametrize(('changes', 'text'), [
    ({'names': ['wheel', 'elbo', 'turn', 'shoulder']},
     "a message lacks elbow; did you mean 'elbo'?"),
    ({'effort': []}, 'effort: expected 4 numbers, one for each name, got 0'),
    ({'effort': [0.0, np.nan, 0.0, 0.0]}, 'are NaN or infinite'),
    ({'position': [0.0, 20.0, 60.0, 45.0]}, 'are they in degrees'),
    ({'stamp': 0}, 'the header stamp is 0'),
])  # fmt: skip
def test_what_cannot_be_used_is_said_in_one_line_and_survived(limb, changes, text):
    published, stamp = len(limb.heard[TORQUE]), limb.stamp
    limb.stamp = changes.get('stamp', stamp + 1_000_000) - 1_000_000
    limb.send(1100, **{k: v for k, v in changes.items() if k != 'stamp'})
    limb.wait_said(text)
    assert len(limb.heard[TORQUE]) == published
    limb.stamp = stamp + 200_000_000  # begin anew
    limb.send(1101)
    assert np.abs(limb.estimate(range(1102, 1200)).effort).max() < 1.0


def test_tare_payload_and_a_second_robot(limb, user):
    limb.description.publish(String(data=URDF.replace('three', 'other')))
    limb.wait_said('a second robot on /limb/robot_description is ignored')
    limb.estimate(range(1202, 1500), push=1.0)
    assert user.call(f'{limb.name}/tare', Trigger, Trigger.Request()).success
    assert np.abs(limb.estimate(range(1500, 1700), push=1.0).effort).max() < 0.5
    parameters = Parameters(user, limb.name)
    assert 'mass >= 0' in parameters.try_to_set(payload=[-1.0, 0.0, 0.0, 0.0]).reason
    assert not parameters.try_to_set(effort='current').successful
    parameters.set(payload=[1.0, 0.0, 0.0, 0.4])
    message = limb.estimate(range(1700, 1900), push=1.0)
    weight = -9.81 * np.sin(MOTION[1][1899][1:].cumsum()) @ [[0.4, 0.0], [0.4, 0.4]]
    np.testing.assert_allclose(message.effort, [0.0, *weight], atol=0.3 * np.abs(weight).max())
    assert user.call(f'{limb.name}/reset', Trigger, Trigger.Request()).success


def test_a_bag_that_begins_again_and_silence_are_said(limb, user):
    limb.send(1000)
    limb.stamp = 10**11
    limb.send(0)
    limb.send(1)
    user.wait(limb.is_answered, 'estimate after the restart')
    limb.wait_said('older than before: the estimates began anew')
    limb.wait_status('arm', ERROR, 'no usable sample on /limb/joint_states for')


def test_a_wrong_setting_is_said_once_and_the_estimates_stop(launch, user, tmp_path):
    urdf = tmp_path / 'three.urdf'
    urdf.write_text(URDF)
    process = launch('arm', namespace='/wrong', robot_description_file=urdf, publish_rate=5000.0)
    limb, begin = Limb(user, process, '/wrong'), time.monotonic()
    text, heard = 'the efforts of all joints have the wrong sign', limb.heard[TORQUE]
    user.wait(lambda: heard or limb.send(0, push=2.0 * MOTION[3][0]), 'first estimate')
    for k in range(len(MOTION[0])):
        limb.send(k, push=2.0 * MOTION[3][k])
        user.wait(lambda: limb.said(text) or limb.is_answered(), f'estimate {k}')
    # A report has what went wrong since the one before: samples go on until one is heard.
    user.wait(
        lambda: any(text in r.statuses['arm'].message for r in limb.reports) or limb.send(k),
        'report',
    )
    assert not limb.is_answered()
    lines = 1 + (time.monotonic() - begin) / 5.0  # once in five seconds
    assert len(limb.said(text)) <= lines
