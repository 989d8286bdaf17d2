# SPDX-License-Identifier: Apache-2.0
"""A robot's own messages in, stamped and typed estimates out."""

import math
from pathlib import Path
import subprocess
import sys

from fake_robot import HALF, unknown_input
from fhaosmo_ros.core.online.estimator import OnlineEstimator
import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from fhaosmo_ros.messages.fields import find_field  # noqa: E402
from fhaosmo_ros.nodes.middleware.definitions import definitions  # noqa: E402
from fhaosmo_ros.nodes.middleware.messages import type_name  # noqa: E402
from geometry_msgs.msg import AccelStamped, PoseStamped, Quaternion, WrenchStamped  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from rig import Client, EstimatorRig, node_process, parameters, Process, ROOT  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_msgs.msg import (  # noqa: E402
    Bool,
    ByteMultiArray,
    Float32,
    Float64,
    Header,
    UInt8MultiArray,
)

ROBOT = (Path(__file__).parent / 'fake_robot.py').read_text(encoding='utf-8')
WARN, STALE = DiagnosticStatus.WARN, DiagnosticStatus.STALE
SECOND = 1_000_000_000


def nanoseconds(stamp: Time) -> int:
    return stamp.sec * SECOND + stamp.nanosec


def joint_state(stamp: int, **position: float) -> JointState:
    return JointState(
        header=Header(stamp=Time(sec=stamp // SECOND, nanosec=stamp % SECOND)),
        name=list(position), position=list(position.values()),
    )  # fmt: skip


def replay(*arguments: object) -> None:
    process = subprocess.run(
        [sys.executable, '-m', 'fhaosmo_ros', 'replay', *map(str, arguments)],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr


# The robot, live, recorded and replayed.


def test_robot_is_estimated_live_as_in_a_replay(client, folder, tmp_path):
    samples, gains = 1500, ROOT / 'config' / 'joint_states.yaml'
    arguments = ['--ros-args', '--params-file', gains]
    for name, value in (
        ('channels', "['']"), ('input_field', 'position[shoulder]'), ('publish_on', 'sample'),
        ('input_reliability', 'reliable'), ('unknown_input_scale', 2.0),
    ):  # fmt: skip
        arguments += ['-p', f'{name}:={value}']
    recorder = Process(folder(), 'record', '-o', tmp_path / 'bag')
    robot = None
    try:
        with node_process(folder(), 'estimator', *arguments):
            rig = EstimatorRig(client, feed=False)
            typed = client.record('/estimator/joint_states', JointState)
            client.wait(lambda: 'recording to' in recorder.output, 'recorder')
            # Recorder, estimator and nobody else; the recorder hears of the topic when it appears.
            robot = Process(folder(), '--samples', str(samples), '--subscribers', '2', code=ROBOT)
            client.wait(lambda: len(typed) == samples, 'estimate of every sample', 60.0)
            rig.wait_count('samples accepted', samples)
            assert rig.count('samples lost') == rig.count('samples rejected') == 0
            assert rig.value('stamps') == 'header'
            client.wait(lambda: len(rig.estimates) == samples, 'all topics of every estimate')
        robot.end()
        first = int(robot.output.split()[-1])
        recorder.end()
    finally:
        for process in (recorder, robot):
            if process is not None:
                process.kill()
    t = np.array([nanoseconds(m.message.header.stamp) - first for m in typed]) / SECOND
    np.testing.assert_allclose(t, np.arange(samples) / 500.0, atol=1e-9)
    message = typed[-1].message
    assert message.name == ['shoulder']
    assert message.position[0] == rig.estimates[-1].z[0]
    assert message.velocity[0] == rig.estimates[-1].z[1]
    assert message.effort[0] == 2.0 * rig.estimates[-1].unknown_input
    d = np.array([m.message.effort[0] for m in typed]) / 2.0
    plateau = (t >= HALF) & (t % HALF >= 0.5 * HALF)
    truth = np.array([unknown_input(x, 0) for x in t])
    error = np.sqrt(np.mean((d - truth)[plateau] ** 2))
    assert error <= 0.07
    # Nothing is said to replay: the bag says what y is.
    replay(tmp_path / 'bag', '--afresh', '-o', tmp_path / 'o.npz')
    with np.load(tmp_path / 'o.npz') as replayed:
        live = {e.stamp: [*e.z, e.unknown_input, e.gamma] for e in rig.estimates}
        names = ['z1', 'z2', 'unknown_input', 'gamma']
        columns = np.column_stack([replayed[name] for name in names])
        assert replayed['stamp_ns'].tolist() == list(live)
    np.testing.assert_allclose(columns, list(live.values()), rtol=0.0, atol=1e-12)


# Many joints of one message.


@pytest.fixture(scope='module')
def arm(client, start):
    """Return a node with channels from the names in the first message, and its rig's parts."""
    process = start(
        'estimator',
        *parameters(
            namespace='/arm', channels='from_joint_names', publish_on='sample', max_gap=60.0,
            typed_outputs='[joint_states]', input_reliability='reliable',
        ),
        '-p', 'elbow.epsilon:=7.0', '-p', 'elbo.epsilon:=7.0',
    )  # fmt: skip
    client.wait(lambda: 'waiting for the first message' in process.output, 'start')
    publish = client.publisher('/arm/joint_states', JointState)
    client.wait(lambda: publish.matched() >= 1, 'subscription')
    out = client.record('/arm/estimator/joint_states', JointState)
    client.wait(lambda: client.node.count_publishers('/arm/estimator/joint_states') == 0, 'wait')
    stamp = SECOND
    first = joint_state(stamp, shoulder=0.1, elbow=0.2, wrist=0.3)
    first.name += ['elbow', 'constants', '', 'left/wrist']  # the second elbow is nobody
    first.position.extend([9.0] * 4)
    publish(first)
    client.wait(lambda: client.node.count_publishers('/arm/estimator/joint_states') == 1, 'arm')
    bad = "left out: 3 joints 'constants', '', 'left/wrist' can't be the name of a channel"
    assert bad in process.output
    return process, publish, out


def test_each_joint_is_a_channel_whatever_the_order_of_the_names(client, arm):
    process, publish, out = arm
    expected = {
        name: OnlineEstimator({'max_gap': 60.0}) for name in ('shoulder', 'elbow', 'wrist')
    }
    expected['elbow'] = OnlineEstimator({'max_gap': 60.0, 'epsilon': 7.0})
    stamp = SECOND
    first = {'shoulder': 0.1, 'elbow': 0.2, 'wrist': 0.3}
    for name, estimator in expected.items():
        estimator.update(stamp, first[name])
    orders = [('shoulder', 'elbow', 'wrist'), ('wrist', 'shoulder', 'elbow'), ('elbow', 'wrist')]
    for k in range(1, 25):
        stamp += 2_000_000
        values = {name: 0.1 * (1 + len(name)) + 0.01 * k for name in orders[k % 3]}
        results = {n: expected[n].update(stamp, y) for n, y in values.items()}
        publish(joint_state(stamp, **values))
        client.wait(
            lambda at=stamp: out and nanoseconds(out[-1].message.header.stamp) == at, 'estimates'
        )
        message = out[-1].message
        assert nanoseconds(message.header.stamp) == stamp
        assert set(message.name) == set(values)
        for name, *numbers in zip(
            message.name, message.position, message.velocity, message.effort, strict=True
        ):
            e = results[name]
            assert numbers == pytest.approx([*e.z[:2], e.unknown_input], abs=1e-12)
    assert (
        "expected a name that is in the message (elbow, wrist), got 'shoulder'" in process.output
    )
    assert "parameters of 'elbo' are not used" in process.output
    assert "did you mean 'elbow'" in process.output
    publish(joint_state(stamp + 2_000_000, shoulder=0.1, elbow=0.2, wrist=0.3, tail=1.0))
    client.wait(lambda: "joint 'tail' has come after" in process.output, 'warning')


# Bad input: one clear line each, counted, survived.


def test_bad_messages_are_told_counted_and_survived(client, folder):
    arguments = parameters(
        namespace='/bad', input_topic='data', input_field='position[elbow]', max_gap=60.0,
        input_reliability='reliable',
        diagnostics_period=0.2, publish_on='sample', typed_outputs='[none]',
    )  # fmt: skip
    with node_process(folder(), 'estimator', *arguments) as process:
        rig = EstimatorRig(client, '/bad', feed=False)
        publish = client.publisher('/bad/data', JointState)
        client.wait(lambda: publish.matched() == 1, 'subscription of the type in the graph')
        stamp = SECOND
        publish(joint_state(stamp, elbow=0.2))
        rig.wait_count('samples accepted', 1)
        publish(b'\0\1\0\0' + bytes(9))  # shorter than any JointState
        rig.wait_count('damaged messages', 1)
        publish(joint_state(stamp + 1, elbwo=0.2))
        rig.wait_count('messages without y', 1)
        assert "got 'elbow'; did you mean 'elbwo'?" in process.output
        message = joint_state(stamp + 2, elbow=0.2)
        message.position = []
        publish(message)
        rig.wait_count('messages without y', 2)
        assert "expected an element for each name, got none for 'elbow'" in process.output
        publish(joint_state(0, elbow=0.2))
        rig.wait_count('zero stamps', 1)
        assert 'its header stamp is 0: nobody fills it; input_stamp: source' in process.output
        publish(joint_state(stamp + 10_000_000, elbow=0.21))
        rig.wait_count('samples accepted', 2)
        rig.wait_status('input', WARN, 'header stamps lie', 'another clock')


def test_type_without_the_field_is_told_until_one_comes_that_has_it(client, start):
    joint = {'input_topic': 'data', 'input_field': 'position[elbow]'}
    process = start('estimator', *parameters(namespace='/kind', **joint))
    rig = EstimatorRig(client, '/kind', feed=False)
    with Client() as other:  # one participant has one type of a topic
        other.publisher('/kind/data', Float64)
        rig.wait_status('input', STALE, "field 'position[elbow]': expected a number in")
        assert process.output.count('expected a number in') == 1
    publish = client.publisher('/kind/data', JointState)
    client.wait(lambda: publish.matched() == 1, 'subscription')
    publish(joint_state(SECOND, elbow=0.2))
    rig.wait_count('samples accepted', 1)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        (
            {'input_type': 'sensor_msgs/msg/Imu', 'input_field': 'angular_velocty.z'},
            ["field 'angular_velocty.z'", 'sensor_msgs/msg/Imu', "mean 'angular_velocity.z'"],
        ),
        ({'input_type': 'nobody/msg/No'}, ["'input_type'", 'is installed here', 'nobody/msg/No']),
        (
            {'input_type': 'std_msgs/msg/Float64', 'input_stamp': 'header'},
            ["'input_stamp'", 'messages with a header', 'std_msgs/msg/Float64'],
        ),
        (
            {'input_type': 'sensor_msgs/msg/JointState'},
            ['a field', 'position[i]'],
        ),
        ({'channels': '[a, b]', 'typed_outputs': '[wrench]'}, ["'output_axis'", 'linear.x']),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_one_line_before_anything_starts(folder, options, words):
    process = Process(folder(), 'estimator', *parameters(**options))
    assert process.wait() == 2, process.output
    (line,) = process.output.strip().splitlines()
    assert all(word in line for word in words), line


# Other messages.


def test_numbers_of_any_kind_in_the_objects_of_rclpy():
    levels = DiagnosticArray(status=[DiagnosticStatus(), DiagnosticStatus(level=b'\2')])
    covariance = Imu(angular_velocity_covariance=np.arange(9.0))
    for message, text, value in (
        (levels, 'status[1].level', 2.0),
        (covariance, 'angular_velocity_covariance[4]', 4.0),
        (Bool(data=True), 'data', 1.0),
        (ByteMultiArray(data=[b'\1', b'\3']), 'data[1]', 3.0),
        (UInt8MultiArray(data=[1, 4]), 'data[1]', 4.0),
        (Float32(data=0.1), 'data', float(np.float32(0.1))),
    ):
        kind = type_name(type(message))
        heard = deserialize_message(serialize_message(message), type(message))
        assert find_field(definitions(kind), kind, text).value(heard) == value


def test_yaw_is_continuous_and_the_outputs_are_typed(client, folder):
    arguments = parameters(
        namespace='/yaw', input_topic='pose', input_field='pose.orientation.yaw', order=2,
        input_reliability='reliable',
        phi="['0', '0']", lambda_='[15.0, 10.0, 5.0]', publish_on='sample', max_gap=60.0,
        typed_outputs='[wrench, accel]', output_axis='angular.z', unknown_input_scale=3.0,
        frame_id='base', measurement_unit='rad', unknown_input_unit="'N m'",
        diagnostics_period=0.2,
    )  # fmt: skip
    wrench = client.record('/yaw/estimator/wrench', WrenchStamped)
    accel = client.record('/yaw/estimator/accel', AccelStamped)
    with node_process(folder(), 'estimator', *arguments):
        rig = EstimatorRig(client, '/yaw', feed=False)
        publish = client.publisher('/yaw/pose', PoseStamped)
        client.wait(lambda: publish.matched() == 1, 'subscription')
        expected = OnlineEstimator({
            'order': 2, 'phi': ['0', '0'], 'lambda': [15.0, 10.0, 5.0], 'max_gap': 60.0,
        })  # fmt: skip
        for k in range(40):
            angle, stamp = 3.0 + 0.2 * k, SECOND + k * 2_000_000
            message = PoseStamped()
            message.header.stamp = Time(sec=1, nanosec=k * 2_000_000)
            message.pose.orientation = Quaternion(z=math.sin(0.5 * angle), w=math.cos(0.5 * angle))
            publish(message)
            client.wait(lambda k=k: len(wrench) > k, 'wrench')
            e = expected.update(stamp, angle)
        assert wrench[-1].message.header.frame_id == 'base'
        assert nanoseconds(wrench[-1].message.header.stamp) == stamp
        assert wrench[-1].message.wrench.torque.z == pytest.approx(3.0 * e.unknown_input, rel=1e-6)
        assert wrench[-1].message.wrench.force.x == 0.0
        client.wait(lambda: len(accel) == 40, 'accel')
        assert accel[-1].message.accel.angular.z == pytest.approx(e.unknown_input, rel=1e-6)
        for key, number in (
            ('unknown input [rad/s^2]', e.unknown_input),
            ('unknown input, scaled [N m]', 3.0 * e.unknown_input),
        ):
            client.wait(
                lambda key=key, number=number: (
                    float(rig.value(key) or 'nan') == pytest.approx(number, rel=1e-4)
                ),
                key,
            )
        described = rig.parameters.describe('spike_gate')['spike_gate']
        assert 'unit of y: rad' in described.additional_constraints


def test_known_input_from_the_message_of_y(client, folder):
    """u of a message is that of its own sample."""
    arguments = parameters(
        namespace='/drive', input_topic='imu', input_field='angular_velocity.z', order=1,
        input_reliability='reliable',
        phi="['u']", lambda_='[15.0, 5.0]', publish_on='sample', max_gap=60.0,
        known_input_topics='[imu]', known_input_fields='[linear_acceleration.x]',
        typed_outputs='[none]',
    )  # fmt: skip
    with node_process(folder(), 'estimator', *arguments):
        rig = EstimatorRig(client, '/drive', feed=False)
        publish = client.publisher('/drive/imu', Imu)
        client.wait(lambda: publish.matched() == 1, 'one subscription')
        expected = OnlineEstimator(
            {'order': 1, 'phi': ['u'], 'lambda': [15.0, 5.0], 'max_gap': 60.0}
        )
        for k in range(20):
            message = Imu()
            message.header.stamp = Time(sec=1, nanosec=(k + 1) * 2_000_000)
            message.angular_velocity.z, message.linear_acceleration.x = 0.01 * k, float(k % 5)
            publish(message)
            client.wait(lambda k=k: len(rig.estimates) > k, 'estimate')
            expected.set_input(float(k % 5))
            e = expected.update(SECOND + (k + 1) * 2_000_000, 0.01 * k)
        assert rig.estimates[-1].unknown_input == pytest.approx(e.unknown_input, abs=1e-12)


def test_known_input_of_another_topic_is_that_of_the_stamp_of_y(client, folder, tmp_path):
    """It arrives after y, remapped; live, replayed and by the library the result is one."""
    model = {
        'order': 1, 'phi': ['k*u'], 'constants.k': 2.0, 'lambda': [15.0, 5.0], 'max_gap': 60.0,
        'known_input_stamps': ['header'], 'known_input_wait': 0.2,
    }  # fmt: skip
    arguments = parameters(
        namespace='/arm2', input_topic='q', input_field='position[a]', publish_on='sample',
        known_input_fields='["effort[a]"]', typed_outputs='[none]', input_reliability='reliable',
        **model,
    )  # fmt: skip
    stamps = [SECOND + (k + 1) * 2_000_000 for k in range(30)]
    recorder = Process(
        folder(), 'record', '-o', tmp_path / 'bag', '--names', '/arm2/estimator', '/arm2/other'
    )
    try:
        client.wait(lambda: 'recording to' in recorder.output, 'recorder')
        with node_process(folder(), 'estimator', *arguments, '-r', 'u:=/motor/state'):
            rig = EstimatorRig(client, '/arm2', feed=False)
            y = client.publisher('/arm2/q', JointState)
            u = client.publisher('/motor/state', JointState)
            client.wait(lambda: y.matched() == u.matched() == 2, 'estimator and recorder')
            client.wait(lambda: rig.diagnostics, 'message: the estimator writes to this client')
            expected = OnlineEstimator(model)
            for k, stamp in enumerate(stamps):
                y(joint_state(stamp, a=0.01 * k))
                client.wait(lambda k=k: len(rig.estimates) == k, 'estimate of the sample before')
                message = joint_state(stamp, a=0.0)
                message.effort = [float(k % 5)]
                u(message)
                expected.set_input(float(k % 5))
                e = expected.update(stamp, 0.01 * k)
                client.wait(lambda k=k: len(rig.estimates) > k, 'estimate with its input')
            y(joint_state(stamps[-1] + 2_000_000, a=0.3))  # its input never comes
            client.wait(lambda: len(rig.estimates) == 31, 'end of the wait')
            u(joint_state(stamps[-1], a=0.0))  # no effort: left out
            message.header.stamp = Time(sec=1, nanosec=62_000_000)
            u(message)
            client.wait(lambda: rig.value('late inputs') == '1', 'count of late inputs')
            live = rig.estimates[29]
            assert live.unknown_input == pytest.approx(e.unknown_input, abs=1e-12)
        recorder.end()
    finally:
        recorder.kill()
    replay(tmp_path / 'bag', '-o', tmp_path / 'o.npz')
    with np.load(tmp_path / 'o.npz') as replayed:
        assert replayed['stamp_ns'].tolist() == [*stamps, stamps[-1] + 2_000_000]
        np.testing.assert_allclose(
            replayed['unknown_input'], [e.unknown_input for e in rig.estimates], atol=1e-12
        )


def test_header_stamps_are_the_time_in_simulation(client, start):
    """dt comes from them, whatever /clock does; without headers it comes from /clock."""
    common = {
        'use_sim_time': 'true', 'publish_on': 'sample', 'input_topic': 'in',
        'typed_outputs': '[none]', 'input_reliability': 'reliable',
    }  # fmt: skip
    process = start(
        'estimator', *parameters(namespace='/stamped', input_field='position[a]', **common)
    )
    start('estimator', *parameters(namespace='/plain', **common))
    publish = {
        'stamped': client.publisher('/stamped/in', JointState),
        'plain': client.publisher('/plain/in'),
    }
    for name in ('stamped', 'plain'):
        client.wait(lambda name=name: publish[name].matched() == 1, f'subscription of {name}')
    rig = EstimatorRig(client, '/stamped', feed=False)
    assert rig.parameters.get('sampling') == 'source_stamp'
    assert rig.parameters.get('use_sim_time') is True
    assert 'dt comes from the header stamps' in process.output
    stamps = [SECOND + (k + 1) * 2_000_000 for k in range(20)]
    for k, stamp in enumerate(stamps):
        publish['stamped'](joint_state(stamp, a=0.01 * k))
    client.wait(lambda: len(rig.estimates) == len(stamps), 'estimate of every sample')
    expected = OnlineEstimator().run(stamps, 0.01 * np.arange(20))
    assert [e.stamp for e in rig.estimates] == stamps
    np.testing.assert_array_equal([e.unknown_input for e in rig.estimates], expected.unknown_input)
    assert EstimatorRig(client, '/plain', feed=False).parameters.get('sampling') == 'clock'
