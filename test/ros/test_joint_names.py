# SPDX-License-Identifier: Apache-2.0
"""Whatever names of joints arrive: one line each, diagnostics, and the good ones go on."""

import time

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rig import node_process, parameters  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Header  # noqa: E402

LONG = 'a' * 300
MANY = [f'j{k}' for k in range(500)]


class Arm:
    """An estimator of whatever joints come, fed and heard."""

    def __init__(self, client, process):
        self.client, self.process = client, process
        self.publish = client.publisher('/arm/joint_states', JointState)
        self.out = client.record('/arm/estimator/joint_states', JointState)
        self.reports = client.record('/diagnostics', DiagnosticArray)
        client.wait(lambda: self.publish.matched() >= 1, 'subscription')
        self.stamp = 1_000_000_000

    def send(self, names):
        self.stamp += 1_000_000
        stamp = Time(sec=self.stamp // 10**9, nanosec=self.stamp % 10**9)
        header = Header(stamp=stamp)
        self.publish(JointState(header=header, name=names, position=[0.1] * len(names)))

    def wait_estimate(self, names):
        def estimated():
            self.send(names)
            return any(m.message.name == names for m in self.out[-5:])

        self.client.wait(estimated, f'estimates of {len(names)} joints')

    def wait_report(self, words):
        self.client.wait(lambda: any(
            s.name == 'arm/estimator: state' and words in s.message
            for published in self.reports[-20:] for s in published.message.status
        ), f'report of {words}')  # fmt: skip

    def lines(self, words):
        return [line for line in self.process.output.splitlines() if words in line]


@pytest.fixture
def arm(client, folder):
    arguments = parameters(
        namespace='/arm', channels='from_joint_names', publish_on='sample', max_gap=60.0,
        input_reliability='reliable', diagnostics_period=0.2, gains='fixed',
    )  # fmt: skip
    with node_process(folder(), 'estimator', *arguments) as process:
        yield Arm(client, process)


def test_name_that_no_topic_can_have_is_left_out(arm):
    arm.send(['hip', LONG, 'a/b'])
    arm.wait_estimate(['hip'])
    (line,) = arm.lines('left out')
    assert "2 joints 'aaaa" in line
    assert "can't be the name of a channel" in line
    assert len(line) < 600
    arm.wait_report("left out: 2 joints 'aaaa")


def test_names_that_come_later_are_one_line(arm):
    arm.send(['hip'])
    arm.wait_estimate(['hip'])
    for k in range(300):
        arm.send(['hip', *(f'late{k}_{i}' for i in range(10))])
        time.sleep(0.001)
    arm.wait_estimate(['hip'])
    assert len(arm.lines('late0_0')) == 1
    assert len(arm.process.output.splitlines()) < 20
    arm.wait_report("joints 'late0_0', 'late0_1'")


def test_names_beyond_max_channels_are_left_out(arm):
    begin = time.monotonic()
    arm.send(MANY)
    arm.wait_estimate(MANY[:64])
    assert time.monotonic() - begin < 20.0
    (line,) = arm.lines('max_channels')
    assert "left out: 436 joints 'j64', 'j65'" in line
    arm.wait_report("left out: 436 joints 'j64'")
