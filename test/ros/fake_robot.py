# SPDX-License-Identifier: Apache-2.0
"""
A robot in a process of its own: a JointState with exact header stamps, and an unknown input.

Each joint is a double integrator that starts at rest, with the unknown acceleration d: 0 and 0.5
in turn, changing every `HALF` seconds, later by a tenth of a second from joint to joint. Sample k
has the header stamp of its time k / rate after the first one, though it may be published later.
"""

import argparse
import signal
import time

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

HALF = 1.0
JUMP = 0.5
SHIFT = 0.1
NAMES = ('shoulder', 'elbow', 'wrist', 'hand', 'thumb', 'index', 'little')


def unknown_input(t: float, joint: int) -> float:
    """Return d of a joint at t seconds after the first sample."""
    return JUMP * (int(max(t - SHIFT * joint, 0.0) / HALF) % 2)


def motion(t: float, joint: int) -> float:
    """Return the joint's position: d integrated twice, exactly."""
    t = max(t - SHIFT * joint, 0.0)
    position = speed = begin = 0.0
    while begin < t:
        step = min(HALF, t - begin)
        d = JUMP * (round(begin / HALF) % 2)
        position += speed * step + 0.5 * d * step * step
        speed += d * step
        begin += HALF
    return position


def main() -> None:
    """Publish until the number of samples is reached, then say so, or until a signal."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--rate', type=float, default=500.0)
    parser.add_argument('--samples', type=int, default=2500)
    parser.add_argument('--joints', type=int, default=1)
    parser.add_argument('--subscribers', type=int, default=1)
    parser.add_argument('--topic', default='joint_states')
    arguments = parser.parse_args()
    ended = False

    def end(*_: object) -> None:
        nonlocal ended
        ended = True

    signal.signal(signal.SIGINT, end)
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('robot', context=context)
    publisher = node.create_publisher(JointState, arguments.topic, 1000)
    while not ended and publisher.get_subscription_count() < arguments.subscribers:
        time.sleep(0.02)
    time.sleep(0.5)  # the other side's match
    print('publishing', flush=True)
    zeros = [0.0] * arguments.joints
    message = JointState(name=NAMES[: arguments.joints], velocity=zeros, effort=zeros)
    count, first, start = 0, time.time_ns(), time.monotonic()
    while not ended and count < (arguments.samples or count + 1):
        t = count / arguments.rate
        time.sleep(max(0.0, start + t - time.monotonic()))
        message.position = [motion(t, joint) for joint in range(arguments.joints)]
        stamp = first + round(t * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        publisher.publish(message)
        count += 1
    print('published', count, first, flush=True)
    while not ended:
        time.sleep(0.05)
    node.destroy_node()
    rclpy.try_shutdown(context=context)


if __name__ == '__main__':
    main()
