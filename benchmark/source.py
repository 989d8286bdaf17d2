# SPDX-License-Identifier: Apache-2.0
"""
Publishes y at an exact rate, from a process of its own.

Sample k is published k periods after the first one: a late one does not delay those behind it.
Begins once it has its subscribers; says at its end how many samples it has published.
"""

import argparse
import math
import signal
import threading
import time

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

JOINTS = [f'joint{k}' for k in range(1, 33)]
SETTLE = 0.5
"""Seconds between the match as seen from here and the first sample: the other side's match."""


def joint_state(count: int) -> JointState:
    """Return a message of so many joints with zeros."""
    zeros = [0.0] * count
    return JointState(name=JOINTS[:count], position=zeros, velocity=zeros, effort=zeros)


def main() -> None:
    """Publish until SIGINT."""
    parser = argparse.ArgumentParser(description='Publishes y at an exact rate.')
    parser.add_argument('--rate', type=float, default=1000.0, help='in Hz')
    parser.add_argument('--joints', type=int, default=0, help='of a JointState instead of y')
    parser.add_argument('--subscribers', type=int, default=1)
    arguments = parser.parse_args()
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node('source', start_parameter_services=False)
    joints = joint_state(arguments.joints) if arguments.joints else None
    kind, topic = (JointState, 'joint_states') if joints else (Float64, 'y')
    publisher = node.create_publisher(kind, topic, 10)
    while not ended.is_set() and publisher.get_subscription_count() < arguments.subscribers:
        time.sleep(0.02)
    time.sleep(SETTLE)
    print('publishing', flush=True)
    message, count, start = joints or Float64(), 0, time.monotonic()
    while not ended.is_set():
        time.sleep(max(0.0, start + count / arguments.rate - time.monotonic()))
        y = 0.2 + 0.1 * math.sin(count / arguments.rate)
        if joints:
            message.position = [y] * arguments.joints
            stamp = divmod(time.time_ns(), 1_000_000_000)
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
        else:
            message.data = y
        publisher.publish(message)
        count += 1
    time.sleep(SETTLE)  # the last samples leave before their writer does
    print('published', count, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
