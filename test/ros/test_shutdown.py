# SPDX-License-Identifier: Apache-2.0
"""Signals end a node cleanly, whenever they come."""

import signal
import time

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from rig import parameters, Process  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402

GRACE = 5.0


def ends_well(process: Process) -> None:
    start = time.monotonic()
    assert process.wait() == 0, process.output
    assert time.monotonic() - start < GRACE
    for word in ('Traceback', 'Exception', 'Error', 'error', 'terminate called'):
        assert word not in process.output, process.output


@pytest.mark.parametrize(
    'signals',
    [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT, signal.SIGINT, signal.SIGTERM)],
    ids=['SIGINT', 'SIGTERM', 'three'],
)
def test_running_pair_ends(client, folder, signals):
    """Both at full rate, so that callbacks run when the signal comes."""
    namespace = f'/end{len(signals)}{signals[0]}'
    nodes = [
        Process(folder(), name, *parameters(namespace=namespace))
        for name in ('plant', 'estimator')
    ]
    try:
        d = client.record(f'{namespace}/estimator/unknown_input', Float64)
        client.wait(lambda: len(d) > 10, 'estimates')
        for number in signals:
            for node in nodes:
                node.send(number)
        for node in nodes:
            ends_well(node)
    finally:
        for node in nodes:
            node.kill()


@pytest.mark.parametrize('name', ['estimator', 'plant'])
@pytest.mark.parametrize('delay', [0.5, 0.8, 1.1])
def test_signal_while_it_starts(folder, name, delay):
    """The delay is the test's subject: anywhere within the start, or just behind it."""
    process = Process(folder(), name, *parameters(namespace='/early'))
    try:
        time.sleep(delay)
        process.send(signal.SIGTERM)
        process.send(signal.SIGINT)
        code = process.wait(GRACE)
        assert 'Traceback' not in process.output, process.output
        assert code in (0, -signal.SIGTERM, -signal.SIGINT, 130), process.output
    finally:
        process.kill()
