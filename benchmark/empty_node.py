# SPDX-License-Identifier: Apache-2.0
"""
A node with the estimator's subscription, timer, publishers and executor that computes nothing.

It publishes messages that were made once, except for the stamp of the latest sample, from which
latencies are measured. What an estimator costs more than this is ours; what this costs is the
middleware's.
"""

import argparse
import signal
import threading

from builtin_interfaces.msg import Time
from fhaosmo_ros.nodes.middleware.diagnostics import DiagnosticsPublisher, Report
from fhaosmo_ros.nodes.middleware.endpoints import SENSOR_QOS, subscribe_with_info
from fhaosmo_ros.nodes.middleware.messages import labelled
from fhaosmo_ros.nodes.middleware.spin import Spinner
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from source import joint_state, JOINTS
from std_msgs.msg import Float64


class EmptyNode(Node):
    """
    Counts samples; publishes constants, and the stamp of the latest sample.

    Parameters
    ----------
    rate : float
        Rate of the timer, in Hz; 0: publish on each sample.
    joints : int
        0: a Float64 on ``y``. Else so many joints of a JointState, with the messages of each.

    """

    def __init__(self, rate: float, joints: int = 0) -> None:
        super().__init__('empty_node')
        self._count = self._latest = 0
        self._stamp, self._joint_states = Time(), joint_state(max(joints, 1))
        outputs = [('~/joint_states', self._joint_states)]
        for prefix in [f'~/{joint}/' for joint in JOINTS[:joints]] or ['~/']:
            outputs += [
                (f'{prefix}state', labelled(['z1', 'z2', 'z3'])(np.zeros(3))),
                (f'{prefix}unknown_input', Float64()),
                (f'{prefix}gamma', Float64()),
                (f'{prefix}innovation', labelled(['eps1', 'eps2', 'eps3', 'eps4'])(np.zeros(4))),
                (f'{prefix}stamp', self._stamp),
            ]
        self._outputs = [
            (self.create_publisher(type(message), topic, 10).publish, message)
            for topic, message in outputs
        ]
        self._diagnostics = DiagnosticsPublisher(
            self, self._reports, {'diagnostics_period': 1.0, 'hardware_id': 'none'}
        )
        self._each = not rate
        if rate:
            self._timer = self.create_timer(1.0 / rate, self._publish)
        kind, topic = (JointState, 'joint_states') if joints else (Float64, 'y')
        self._y = subscribe_with_info(self, kind, topic, self._on_sample, SENSOR_QOS)
        self.get_logger().info('computing nothing')

    def _on_sample(self, message: Float64 | JointState, info: dict[str, int]) -> None:
        self._count += 1
        self._latest = info['source_timestamp']
        if isinstance(message, JointState):
            stamp = message.header.stamp
            self._latest = stamp.sec * 1_000_000_000 + stamp.nanosec
        if self._each:
            self._publish()

    def _publish(self) -> None:
        if self._latest:
            self._stamp.sec, self._stamp.nanosec = divmod(self._latest, 1_000_000_000)
            self._joint_states.header.stamp = self._stamp
            for publish, message in self._outputs:
                publish(message)

    def _reports(self) -> list[Report]:
        """Return as many values as the estimator's reports have."""
        report = Report('input')
        report.values = {'samples accepted': self._count, **{f'value {k}': 0 for k in range(30)}}
        return [report]


def main() -> None:
    """Run the node until SIGINT."""
    parser = argparse.ArgumentParser(description='A node that computes nothing.')
    parser.add_argument('--rate', type=float, default=100.0, help='of the timer; 0: on samples')
    parser.add_argument('--joints', type=int, default=0, help='of a JointState instead of y')
    arguments = parser.parse_args()
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = EmptyNode(arguments.rate, arguments.joints)
    with Spinner(node, on_end=ended.set):
        ended.wait()
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
