# SPDX-License-Identifier: Apache-2.0
"""A node with smoothing_lag publishes what replay --lag computes, stamped with its own time."""

import math

from fhaosmo_ros.core.online.estimator import OnlineEstimator
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

VALUES = {
    'order': 2, 'phi': ['0', '-z2'], 'noise_size': 1e-3, 'unknown_input_size': 1.0,
    'smoothing_lag': 0.05, 'max_gap': 60.0, 'publish_on': 'sample',
}  # fmt: skip


@pytest.mark.parametrize('channel', ['', 'hip'])
def test_live_estimates_are_those_of_a_replay(channel, client, start):
    namespace, part = f'/past{channel}', f'{channel}/' if channel else ''
    texts = {**VALUES, 'channels': [channel]}
    options = [word for name, value in texts.items() for word in ('-p', f'{name}:={value!s}')]
    start('estimator', '--ros-args', '-r', f'__ns:={namespace}', *options)
    node = f'{namespace}/estimator/{part}'
    sent = client.record(f'{namespace}/{part}y', Float64)
    inputs = client.record(f'{node}unknown_input', Float64)
    stamps = client.record(f'{node}stamp', Time)
    publish = client.publisher(f'{namespace}/{part}y')
    client.wait(lambda: publish.matched() >= 2, 'subscription of y')
    client.wait(lambda: client.node.count_publishers(f'{node}stamp'), 'estimator')

    def feed(wanted):
        count = len(sent)
        publish(0.1 * math.sin(0.1 * count))
        client.wait(lambda: len(sent) > count, 'own sample')
        return len(stamps) > wanted

    client.wait(lambda: feed(0), 'first estimate')
    assert client.call(f'{node}reset', Trigger, Trigger.Request()).success
    first, before = len(sent), len(stamps)
    client.wait(lambda: feed(before + 40), 'estimates')
    client.wait(lambda: len(inputs) >= len(stamps), 'estimates of d')
    heard = stamps[before:]
    times = [p.message.sec * 10**9 + p.message.nanosec for p in heard]
    estimator = OnlineEstimator({k: v for k, v in VALUES.items() if k != 'publish_on'})
    rows = estimator.run(
        [s.stamp for s in sent[first:]], [s.message.data for s in sent[first:]]
    )  # what the node has heard since the reset
    known = dict(zip(rows.t.tolist(), rows.unknown_input.tolist(), strict=True))
    assert set(times) <= set(known)
    # Either topic may be ahead of the other by a message.
    assert {p.message.data for p in inputs[-30:]} <= set(known.values())
    delays = [p.stamp - t for p, t in zip(heard, times, strict=True)]
    assert min(delays) >= 50_000_000
