# SPDX-License-Identifier: Apache-2.0
"""The arm node over the middleware: who it waits for, what it publishes, what it cannot use."""

from pathlib import Path
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('pinocchio')
sys.path.insert(0, str(Path(__file__).parents[1] / 'arm'))

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.arm.model import ArmModel, Payload
from geometry_msgs.msg import WrenchStamped
from robots import JOINTS, motion, URDF
from running import as_time, DEADLINE, ERROR, LATCHED, nanoseconds, OK, Parameters, WARN
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

NODE = '/limb/arm'
NOISE = 2e-5
PUSH = np.array([0.0, -6.0, -5.0])
MOTION = motion(ArmModel(URDF), 6.0)


@pytest.fixture(scope='module')
def limb(launch, user):
    """Return an arm node that has heard its robot's description, and everything around it."""
    process = launch(
        'arm', namespace='/limb', wrench_frame='tool', publish_rate=5000.0, diagnostics_period=0.2,
        position_noise=f'[{NOISE}]',
    )  # fmt: skip
    heard = {
        name: user.record(f'{NODE}/{name}', kind) for name, kind in (
            ('external_torque', JointState), ('standard_deviation', JointState),
            ('joint_states', JointState), ('external_wrench', WrenchStamped),
        )
    }  # fmt: skip
    events = user.record(f'{NODE}/event', DiagnosticArray, LATCHED)
    description = user.publisher('/limb/robot_description', String, qos=LATCHED)
    limb = SimpleNamespace(
        process=process, heard=heard, events=events, description=description, stamp=10**12,
        samples=user.publisher('/limb/joint_states', JointState), sent=[],
    )  # fmt: skip

    def said(text):
        user.wait(lambda: text in process.output(), f'line with {text!r} in the log')

    def send(k, push=0.0, names=JOINTS, **changes):
        """Send the k-th sample of the motion, a millisecond after the one before."""
        limb.stamp += 1_000_000
        fields = {'position': MOTION[1][k], 'effort': MOTION[3][k] - push, **changes}
        fields = {name: [float(x) for x in values] for name, values in fields.items()}
        limb.sent.append((limb.stamp, fields))
        limb.samples.publish(
            JointState(header=Header(stamp=as_time(limb.stamp)), name=list(names), **fields)
        )

    def estimate(k, **options):
        """Send a sample, and return the estimate of it."""
        send(k, **options)
        stamp = limb.stamp
        user.wait(
            lambda: heard['external_torque']
            and nanoseconds(heard['external_torque'][-1].message.header.stamp) >= stamp,
            f'estimate of sample {k}', DEADLINE,
        )  # fmt: skip
        return heard['external_torque'][-1].message

    limb.said, limb.send, limb.estimate = said, send, estimate
    said('waiting for the robot on /limb/robot_description')
    user.wait(
        lambda: any('no robot yet' in s.message for r in user.reports['limb/arm']
                    for s in r.statuses.values()), 'report that there is no robot',
    )  # fmt: skip
    description.publish(String(data='rubbish'))
    said('robot description: expected the XML of a URDF')
    description.publish(String(data=URDF))
    said('estimating the external torques of turn, shoulder, elbow')
    # Estimates are lost until the node's publishers have found who listens.
    user.wait(lambda: all(heard.values()) or send(0), 'first estimates')
    for k in range(1, 500):
        estimate(k)
    return limb


def test_node_and_library_agree_on_the_same_samples(limb, user):
    arm = Arm(URDF, position_noise=[NOISE])
    expected = {}
    for stamp, sample in limb.sent:
        found = arm.take(stamp, sample['position'], sample['effort'])
        if found is not None:
            expected[found.stamp] = found
    for name, of in (
        ('external_torque', lambda e: (e.external_torque, 'effort')),
        ('standard_deviation', lambda e: (e.standard_deviation, 'effort')),
        ('joint_states', lambda e: (e.velocity, 'velocity')),
    ):
        user.wait(lambda name=name: len(limb.heard[name]) >= 499, f'{name} of each sample')
        for message in [m.message for m in limb.heard[name]]:
            values, field = of(expected[nanoseconds(message.header.stamp)])
            assert message.name == list(JOINTS)
            np.testing.assert_array_equal(getattr(message, field), values)


def test_a_contact_is_an_event_with_its_link_and_ends(limb, user):
    begun = len(limb.events)
    for k in range(500, 700):
        message = limb.estimate(k, push=PUSH)
    np.testing.assert_allclose(message.effort, PUSH, atol=1.5)
    user.wait(lambda: len(limb.events) > begun, 'event')
    status = limb.events[begun].message.status[0]
    assert (status.level, status.name) == (WARN, 'limb/arm: contact')
    assert status.message in (f'contact, most likely at {link}' for link in ('upper', 'lower'))
    assert limb.heard['external_wrench'][-1].message.header.frame_id == 'tool'
    for k in range(700, 1000):
        limb.estimate(k)
    user.wait(lambda: limb.events[-1].message.status[0].level == OK, 'end of the contact')


def test_joints_are_found_by_their_names(limb):
    order = [2, 0, 1]
    names = ['wheel', *(JOINTS[j] for j in order)]
    for k in range(1000, 1100):
        message = limb.estimate(
            k, names=names, position=[9.0, *MOTION[1][k][order]],
            effort=[0.0, *MOTION[3][k][order]],
        )  # fmt: skip
    assert np.abs(message.effort).max() < 1.0


@pytest.mark.parametrize(('changes', 'text'), [
    ({'names': ('turn', 'shoulder'), 'position': [0.0, 0.0], 'effort': [0.0, 0.0]},
     'a message lacks elbow'),
    ({'names': ('turn', 'shoulder', 'elbo')}, "a message lacks elbow; did you mean 'elbo'?"),
    ({'effort': []}, 'effort: expected 3 numbers, one for each name, got 0'),
    ({'effort': [np.nan, 0.0, 0.0]}, 'are NaN or infinite'),
    ({'position': [20.0, 60.0, 45.0]}, 'are they in degrees'),
])  # fmt: skip
def test_what_cannot_be_used_is_said_in_one_line_and_survived(limb, changes, text):
    published = len(limb.heard['external_torque'])
    limb.send(1100, **changes)
    limb.said(text)
    assert len(limb.heard['external_torque']) == published
    limb.stamp += 200_000_000  # begin anew
    limb.send(1101)
    for k in range(1102, 1200):
        message = limb.estimate(k)
    assert np.abs(message.effort).max() < 1.0


def test_stamps_of_zero_and_a_second_robot_are_refused(limb):
    stamp, limb.stamp = limb.stamp, -1_000_000
    limb.send(1200)
    limb.said('the header stamp is 0')
    limb.stamp = stamp
    limb.description.publish(String(data=URDF.replace('three', 'other')))
    limb.said('a second robot on /limb/robot_description is ignored')
    limb.estimate(1201)


def test_tare_reset_and_payload(limb, user):
    for k in range(1202, 1500):
        limb.estimate(k, push=1.0)
    answer = user.call(f'{NODE}/tare', Trigger, Trigger.Request())
    assert answer.success, answer.message
    for k in range(1500, 1700):
        message = limb.estimate(k, push=1.0)
    assert np.abs(message.effort).max() < 0.5
    parameters = Parameters(user, NODE)
    refused = parameters.try_to_set('payload', [-1.0, 0.0, 0.0, 0.0])
    assert not refused.successful
    assert 'mass >= 0' in refused.reason
    assert not parameters.try_to_set('effort', 'current').successful
    parameters.set(payload=[1.0, 0.0, 0.0, 0.4])
    for k in range(1700, 1900):
        message = limb.estimate(k, push=1.0)
    model = ArmModel(URDF)
    rest = np.zeros(3)
    bare = model.terms(MOTION[1][1899], rest).gravity
    model.set_payload(Payload(1.0, (0.0, 0.0, 0.4)))
    more = model.terms(MOTION[1][1899], rest).gravity - bare
    assert np.linalg.norm(np.array(message.effort) - more) < 0.3 * np.linalg.norm(more)
    assert user.call(f'{NODE}/reset', Trigger, Trigger.Request()).success


def test_a_wrong_setting_is_said_once_and_the_estimates_stop(launch, user, tmp_path):
    urdf = tmp_path / 'three.urdf'
    urdf.write_text(URDF)
    process = launch(
        'arm', namespace='/wrong', robot_description_file=urdf, publish_rate=5000.0
    )  # fmt: skip
    samples = user.publisher('/wrong/joint_states', JointState)
    torques = user.record('/wrong/arm/external_torque', JointState)
    begin = time.monotonic()
    text = 'the efforts of all joints have the wrong sign'
    stamps = iter(range(10**12, 10**13, 1_000_000))

    def send(k):
        message = JointState(header=Header(stamp=as_time(next(stamps))), name=JOINTS)
        message.position, message.effort = MOTION[1][k].tolist(), (-MOTION[3][k]).tolist()
        samples.publish(message)

    # Estimates are lost until the node's publisher has found who listens.
    user.wait(lambda: torques or send(0), 'first estimate')
    first = len(torques)
    for k in range(len(MOTION[0])):
        send(k)
        if k % 20 == 19 and text not in process.output():
            user.wait(
                lambda n=first + k: text in process.output() or len(torques) >= n, f'estimate {k}'
            )
    user.wait(lambda: any(
        text in s.message for r in user.reports['wrong/arm'] for s in r.statuses.values()
    ), 'report')  # fmt: skip
    assert len(torques) < first + len(MOTION[0]) - 200
    lines = 1 + (time.monotonic() - begin) / 5.0  # once in five seconds
    assert 1 <= process.output().count(text) <= lines


def test_a_bag_that_begins_again_and_silence_are_said(limb, user):
    stamp = limb.stamp
    for k in range(1000, 1003):
        limb.send(k, push=1.0)
    limb.stamp = 10**11
    limb.send(0)
    limb.send(1)
    heard = limb.heard['external_torque']
    user.wait(
        lambda: nanoseconds(heard[-1].message.header.stamp) == limb.stamp,
        'estimate after the restart',
    )  # fmt: skip
    limb.said('older than before: the estimates began anew')
    limb.stamp, since = stamp, len(user.reports['limb/arm'])
    user.wait(
        lambda: any(
            s.level == ERROR and 'no usable sample on /limb/joint_states for' in s.message
            for r in user.reports['limb/arm'][since:] for s in r.statuses.values()
        ), 'report of silence',
    )  # fmt: skip


@pytest.mark.parametrize(('values', 'text'), [
    ({'robot_description_file': '/none.urdf'}, "parameter 'robot_description_file': expected a"),
    ({'measurement': 'torque'}, 'expected one of position, velocity'),
    ({'payload': '[1.0]'}, "parameter 'payload'"),
])  # fmt: skip
def test_bad_parameters_end_the_node_in_one_line(launch, tmp_path, values, text):
    urdf = tmp_path / 'three.urdf'
    urdf.write_text(URDF)
    process = launch('arm', **{'robot_description_file': urdf, **values})
    assert process.wait() == 2
    assert text in process.output()
    assert process.output().count('\n') == 1
