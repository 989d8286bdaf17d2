# SPDX-License-Identifier: Apache-2.0
"""
What stands around an estimator in the benchmark: `around.py source`, `around.py empty_node`.

The source publishes y at an exact rate: sample k comes k periods after the first one, and a late
one does not delay those behind it. It begins once it has two subscribers, and says at its end how
many samples it has published.

The empty node has the estimator's subscription, timer, publishers and executor, and computes
nothing. Its messages were made once, except for the stamp of the latest sample, from which
latencies are measured. What an estimator costs more than this is ours; what this costs is the
middleware's.
"""

import argparse
import math
import signal
import threading
import time

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
from std_msgs.msg import Float64

JOINTS = [f'joint{k}' for k in range(1, 33)]
SUBSCRIBERS = 2
SETTLE = 0.5
"""Seconds between the match as seen from here and the first sample: the other side's match."""


def joint_state(count: int) -> JointState:
    """Return a message of so many joints with zeros."""
    zeros = [0.0] * count
    return JointState(name=JOINTS[:count], position=zeros, velocity=zeros, effort=zeros)


def source(rate: float, joints: int, ended: threading.Event) -> None:
    """Publish y, or the positions of some joints, at a rate (Hz) until the end."""
    node = Node('source', start_parameter_services=False)
    message = joint_state(joints) if joints else Float64()
    publisher = node.create_publisher(type(message), 'joint_states' if joints else 'y', 10)
    while not ended.is_set() and publisher.get_subscription_count() < SUBSCRIBERS:
        time.sleep(0.02)
    time.sleep(SETTLE)
    print('publishing', flush=True)
    count, start = 0, time.monotonic()
    while not ended.is_set():
        time.sleep(max(0.0, start + count / rate - time.monotonic()))
        y = 0.2 + 0.1 * math.sin(count / rate)
        if joints:
            message.position = [y] * joints
            stamp = divmod(time.time_ns(), 1_000_000_000)
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
        else:
            message.data = y
        publisher.publish(message)
        count += 1
    time.sleep(SETTLE)  # the last samples leave before their writer does
    print('published', count, flush=True)
    node.destroy_node()


class EmptyNode(Node):
    """Counts samples; publishes constants, and the stamp of the latest sample; see `source`."""

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
    """Run one of them until SIGINT."""
    parser = argparse.ArgumentParser(description='Source of y, and a node that computes nothing.')
    parser.add_argument('what', choices=('source', 'empty_node'))
    parser.add_argument('--rate', type=float, default=1000.0, help='Hz; 0: on samples')
    parser.add_argument('--joints', type=int, default=0, help='of a JointState instead of y')
    arguments = parser.parse_args()
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    if arguments.what == 'source':
        source(arguments.rate, arguments.joints, ended)
    else:
        node = EmptyNode(arguments.rate, arguments.joints)
        with Spinner(node, on_end=ended.set):
            ended.wait()
        node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
