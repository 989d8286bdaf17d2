# SPDX-License-Identifier: Apache-2.0
"""Signals end a node cleanly, whenever they come."""

import signal
import time

import pytest
from rclpy.parameter import Parameter
from running import Manager, Parameters
from std_msgs.msg import Float64

GRACE = 30.0
"""Seconds: one, and what a loaded machine adds."""


def ends_well(process) -> None:
    assert process.wait(GRACE) == 0, process.output()
    words = ('Traceback', 'Exception', 'Error', 'error', 'terminate called')
    assert not [word for word in words if word in process.output()], process.output()


@pytest.mark.parametrize('signals', [['SIGHUP'], ['SIGTERM', 'SIGINT', 'SIGINT']], ids=len)
def test_running_pair_ends(user, launch, signals):
    """At full rate, and with requests that wait, so that callbacks run when the signal comes."""
    namespace = f'/end_{signals[0]}'
    topic = f'{namespace}/estimator/unknown_input'
    d = user.record(topic, Float64)
    nodes = [
        launch('plant', namespace=namespace),
        launch('estimator', namespace=namespace, publish_rate=1000.0),
    ]
    user.wait(lambda: len(d) > 10, 'estimates')
    parameters = Parameters(user, f'{namespace}/estimator')
    for _ in range(20):
        parameters.service.set_parameters([Parameter('variant', value='fuzzy')])
    for name in signals:
        for node in nodes:
            node.send_signal(signal.Signals[name])
    for node in nodes:
        ends_well(node)
    user.wait(lambda: user.node.count_publishers(topic) == 0, 'end of the publishers')


def test_a_signal_ends_it_in_every_state(user, launch):
    nodes = {
        transition: launch('estimator', namespace=f'/after_{transition}', autostart=False)
        for transition in ('', 'configure', 'shutdown')
    }
    for transition, process in nodes.items():
        manager = Manager(user, f'/after_{transition}/estimator')
        assert manager.state() == 'unconfigured'
        assert not transition or manager.change(transition)
        process.send_signal(signal.SIGINT)
        ends_well(process)


@pytest.mark.parametrize('delay', [0.3, 0.7])
def test_signal_while_it_starts(launch, delay):
    """The delay is the test's subject: anywhere within the start, or just behind it."""
    nodes = [launch(name, namespace='/early') for name in ('estimator', 'plant')]
    time.sleep(delay)
    for process in nodes:
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGINT)
    for process in nodes:
        code = process.wait(GRACE)
        # Python itself dies of a signal before it has begun with our code.
        assert code in (0, -signal.SIGTERM, -signal.SIGINT), process.output()


STUCK = """
import sys, time
from fhaosmo_ros.__main__ import main
from rclpy.node import Node

def stuck(self, period, callback, *args, create=Node.create_timer, **options):
    def sleep():
        print('asleep', flush=True)
        time.sleep(3600.0)
    return create(self, period, sleep, *args, **options)

Node.create_timer = stuck
sys.exit(main(sys.argv[1:]))
"""


def test_a_callback_that_does_not_end_does_not_hold_the_node(user, launch):
    process = launch(STUCK)
    user.wait(lambda: 'asleep' in process.output(), 'callback')
    process.send_signal(signal.SIGINT)
    ends_well(process)
    assert 'ended while a callback was running' in process.output()
