# SPDX-License-Identifier: Apache-2.0
"""A robot's own messages in, stamped and typed estimates out."""

import math

from fhaosmo_ros.__main__ import main
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.messages.fields import find_field
from fhaosmo_ros.nodes.middleware.messages import definitions
from geometry_msgs.msg import AccelStamped, Quaternion, WrenchStamped
import numpy as np
import pytest
from running import as_time, ERROR, FED, joint_state, nanoseconds, SECOND, STALE, User, WARN
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import ByteMultiArray, Float64, Header

STEP = 2_000_000
"""Nanoseconds between two header stamps."""


def test_bad_messages_are_told_counted_and_survived(user, estimator):
    rig = estimator(
        '/bad', reliable=['data'], input_topic='data', input_field='position[elbow]', **FED
    )
    with User('other') as other:  # one participant has one type of a topic
        other.node.create_publisher(Float64, '/bad/data', 10)
        for _ in range(2):
            rig.wait_status('input', ERROR, "field 'position[elbow]': expected a number in")
        assert len(rig.said('input: ', 'expected a number in')) == 1
    data = user.publisher('/bad/data', JointState)  # of a type that has the field
    data.publish(joint_state(SECOND, ['elbow'], [0.2]))
    rig.wait_count('samples accepted', 1)
    data.publish(b'\0\1\0\0' + bytes(9))  # shorter than any JointState
    data.publish(joint_state(SECOND + 1, ['elbwo'], [0.2]))
    data.publish(joint_state(SECOND + 2, ['elbow'], []))
    rig.wait_count('messages without y', 2)
    rig.wait_count('samples lost', 1)
    unset = joint_state(0, ['elbow'], [0.2])
    said = 'their stamps are 0: nobody fills the header; input_stamp: source does without it'
    rig.wait_status('input', ERROR, said, doing=lambda: data.publish(unset))
    data.publish(joint_state(SECOND + 10 * STEP, ['elbow'], [0.21]))
    rig.wait_count('samples accepted', 2)
    rig.wait_status('input', WARN, 'header stamps lie')


def test_bytes_are_numbers():
    """They are numbers to rosbags, and bytes to rclpy."""
    kind = 'std_msgs/msg/ByteMultiArray'
    field = find_field(definitions(kind), kind, 'data[1]')
    assert field.value(ByteMultiArray(data=[b'\1', b'\2'])) == 2.0


def test_yaw_and_known_input_from_the_message_of_y_and_typed_outputs(user, estimator):
    """Yaw is continuous; u is that of its own sample; whatever /clock does, dt is of headers."""
    model = {'order': 2, 'phi': ['0', 'u'], 'lambda': [15.0, 10.0, 5.0], 'epsilon': 1e3}
    wrench = user.record('/imu/estimator/wrench', WrenchStamped)
    accel = user.record('/imu/estimator/accel', AccelStamped)
    rig = estimator(
        '/imu', reliable=['data'], input_topic='data', input_field='orientation.yaw',
        **FED | model, known_input_topics=['data'], use_sim_time=True,
        known_input_fields=['linear_acceleration.x'],
        typed_outputs=['wrench', 'accel'], output_axis='angular.z', unknown_input_scale=3.0,
        frame_id='base', measurement_unit='rad',
    )  # fmt: skip
    imu = user.publisher('/imu/data', Imu)
    rig.wait_said('dt comes from the header stamps')
    assert rig.parameters.get('sampling') == 'source_stamp'
    expected = OnlineEstimator(model | {'max_gap': 60.0})
    for k in range(40):
        angle, stamp = 3.0 + 0.2 * k, SECOND + k * STEP
        message = Imu(header=Header(stamp=as_time(stamp)))
        message.orientation = Quaternion(z=math.sin(0.5 * angle), w=math.cos(0.5 * angle))
        message.linear_acceleration.x = float(k % 5)
        imu.publish(message)
        user.wait(lambda k=k: len(wrench) > k and len(accel) > k, 'wrench and accel')
        expected.set_input(float(k % 5))
        e = expected.update(stamp, angle)
    np.testing.assert_allclose(rig.estimates[-1].z, e.z, rtol=1e-6)
    assert abs(e.unknown_input) > 0.01
    message, d = wrench[-1].message, pytest.approx(e.unknown_input, rel=1e-6)
    assert message.header.frame_id == 'base'
    assert nanoseconds(message.header.stamp) == stamp
    assert message.wrench.torque.z / 3.0 == d
    assert accel[-1].message.accel.angular.z == d
    key, near = 'unknown input [rad/s^2]', pytest.approx(e.unknown_input, rel=1e-4)
    user.wait(lambda: float(rig.value(key) or 'nan') == near, key)


def test_simulated_time_takes_header_stamps_before_all_types_are_known(estimator):
    kind = 'sensor_msgs/msg/JointState'
    own = {'a.input_type': kind, 'b.input_topic': 'nobody', 'b.input_field': 'x'}
    rig = estimator('/known', reliable=[], use_sim_time=True, channels=['a', 'b'], **own)
    rig.wait_said('dt comes from the header stamps')


def test_known_input_of_another_topic_is_the_latest_one(user, estimator, launch, tmp_path):
    """It is remapped; live, replayed and by the library the result is one."""
    model = {
        'order': 1, 'phi': ['k*u'], 'constants.k': 2.0, 'lambda': [15.0, 5.0], 'max_gap': 60.0
    }  # fmt: skip
    process = launch('record', '--', '-o', tmp_path / 'bag', '--names', '/arm2/estimator')
    user.wait(lambda: 'recording to' in process.output(), 'recorder')
    rig = estimator(
        '/arm2', '-r', 'u:=/motor/state', reliable=['q', '/motor/state'], input_topic='q',
        input_field='position[a]', known_input_fields=['effort[a]'], **FED | model,
    )  # fmt: skip
    y = user.publisher('/arm2/q', JointState, heard=2)
    rig.wait_status('input', STALE, 'no publisher of u')
    u = user.publisher('/motor/state', JointState, heard=2)

    def send_u(*effort: float) -> None:
        message = joint_state(SECOND, ['a'], [0.0])
        message.effort = effort
        u.publish(message)

    stamps = [SECOND + k * STEP for k in range(30)]
    expected = OnlineEstimator(model)
    for k, stamp in enumerate(stamps):
        if k % 10 == 5:
            send_u(float(k))
            send_u()  # no effort: left out
            send_u(math.nan)  # the last one is held
            rig.wait_count('rejected inputs', k // 10 + 1)  # all of them have arrived
            expected.set_input(float(k))
        y.publish(joint_state(stamp, ['a'], [0.01 * k]))
        e = expected.update(stamp, 0.01 * k)
        user.wait(lambda k=k: len(rig.estimates) > k, 'estimate')
    assert rig.estimates[-1].z == list(e.z)
    process.stop()
    # Nothing is said to replay: the bag says what y and u are.
    assert main(['replay', str(tmp_path / 'bag'), '-o', str(tmp_path / 'out.npz')]) == 0
    with np.load(tmp_path / 'out.npz') as replayed:
        assert replayed['stamp_ns'].tolist() == stamps
        found = [(e.z[0], e.unknown_input) for e in rig.estimates]
        again = np.column_stack([replayed['z1'], replayed['unknown_input']])
        np.testing.assert_allclose(again, found, atol=1e-12)
