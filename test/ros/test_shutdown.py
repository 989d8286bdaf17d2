# SPDX-License-Identifier: Apache-2.0
"""Signals end a node cleanly, whenever they come."""

import signal
import subprocess
import sys
import time

from fhaosmo_ros.stop_signals import Stop, Stopped
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from rig import Parameters, parameters, Process  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402
from waiting import wait_until  # noqa: E402

GRACE = 20.0
"""Seconds: one, and what a loaded machine adds."""


def ends_well(process: Process) -> None:
    assert process.wait(GRACE) == 0, process.output
    for word in ('Traceback', 'Exception', 'Error', 'error', 'terminate called'):
        assert word not in process.output, process.output


@pytest.mark.parametrize(
    'signals',
    [
        (signal.SIGINT,),
        (signal.SIGTERM,),
        (signal.SIGHUP,),
        (signal.SIGINT, signal.SIGINT, signal.SIGTERM),
    ],
    ids=['SIGINT', 'SIGTERM', 'SIGHUP', 'three'],
)
def test_running_pair_ends(client, folder, signals):
    """Both at full rate, so that callbacks run when the signal comes."""
    namespace = f'/end{len(signals)}{signals[0]}'
    nodes = [
        Process(folder(), 'plant', *parameters(namespace=namespace)),
        Process(folder(), 'estimator', *parameters(namespace=namespace, publish_rate=1000.0)),
    ]
    try:
        d = client.record(f'{namespace}/estimator/unknown_input', Float64)
        client.wait(lambda: len(d) > 10, 'estimates')
        for number in signals:
            for node in nodes:
                node.send(number)
        for node in nodes:
            ends_well(node)
        name = f'{namespace}/estimator/unknown_input'
        client.wait(lambda: client.node.count_publishers(name) == 0, 'end of the publishers')
    finally:
        for node in nodes:
            node.kill()


def test_signal_while_parameters_are_set(client, folder):
    """A call that is being answered, or waits to be, when the signal comes."""
    process = Process(folder(), 'estimator', *parameters(namespace='/set'))
    try:
        values = Parameters(client, '/set/estimator')
        assert values.set(epsilon=4.0)[0].successful
        request = values.request(fuzzy_systems=['terms gaussian 5'], variant='fuzzy')
        for _ in range(20):
            client.call_later('/set/estimator/set_parameters', *request)
        process.send(signal.SIGINT)
        ends_well(process)
    finally:
        process.kill()


@pytest.mark.parametrize('name', ['estimator', 'plant'])
@pytest.mark.parametrize('delay', [0.2, 0.5, 0.8, 1.1])
def test_signal_while_it_starts(folder, name, delay):
    """The delay is the test's subject: anywhere within the start, or just behind it."""
    process = Process(folder(), name, *parameters(namespace='/early'))
    try:
        time.sleep(delay)
        process.send(signal.SIGTERM)
        process.send(signal.SIGINT)
        code = process.wait(GRACE)
        assert 'Traceback' not in process.output, process.output
        # Python itself dies of a signal before it has begun with our code.
        assert code in (0, -signal.SIGTERM, -signal.SIGINT), process.output
    finally:
        process.kill()


def test_a_signal_cuts_only_what_may_be_cut_and_only_once():
    stop = Stop()
    with pytest.raises(Stopped), stop.raising():
        stop.signal()
    stop.signal()  # in the clean-up
    assert stop.is_set()
    with pytest.raises(Stopped), stop.raising():
        raise AssertionError('the signal came before')
    quiet = Stop()
    quiet.signal()
    assert quiet.wait(0.0)


IN_A_LIBRARY = """
import ctypes, signal
from threading import Timer
from fhaosmo_ros.stop_signals import stop_on_signals

with stop_on_signals().raising(0.2):
    # In the timer's thread, so that the system call of this one goes on.
    Timer(0.5, signal.raise_signal, (signal.SIGTERM,)).start()
    ctypes.CDLL(None).sleep(3600)
    print('ended')
"""


def test_what_python_cannot_interrupt_ends_too():
    command = [sys.executable, '-c', IN_A_LIBRARY]
    ended = subprocess.run(command, capture_output=True, timeout=60.0, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b'', b'')


STUCK = """
import signal, sys, time
from fhaosmo_ros.nodes.middleware.spin import run_node
from rclpy.node import Node

class Sleeper(Node):
    def __init__(self, given):
        super().__init__('sleeper')
        self.create_timer(0.01, self.sleep)

    def sleep(self):
        print('asleep', flush=True)
        time.sleep(3600.0)

sys.exit(run_node('plant', Sleeper, []))
"""


def test_a_callback_that_does_not_end_does_not_hold_the_node(folder):
    process = Process(folder(), code=STUCK)
    try:
        wait_until(lambda: 'asleep' in process.output, 'callback')
        process.send(signal.SIGINT)
        ends_well(process)
        assert 'ended while a callback was running' in process.output
    finally:
        process.kill()
