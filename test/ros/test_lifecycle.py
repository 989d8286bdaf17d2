# SPDX-License-Identifier: Apache-2.0
"""Life of a node: the services that `ros2 lifecycle` calls, and signals, whenever they come."""

import signal

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import pytest
from rclpy.parameter import Parameter
from running import Estimator, FED, Manager, OK, Parameters, STALE
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

NODE = '/managed/estimator'


@pytest.fixture(scope='module')
def process(launch):
    return launch('estimator', namespace='/managed', reliable=['y'], autostart=False, **FED)


@pytest.fixture
def unconfigured(user, process):
    """Return the manager of the node, in the state in which it started."""
    manager = Manager(user, NODE)
    for state, transition in (('active', 'deactivate'), ('inactive', 'cleanup')):
        if manager.state() == state:
            assert manager.change(transition)
    assert manager.state() == 'unconfigured'
    return manager


def test_life_of_a_node(user, unconfigured, process):
    node = unconfigured
    assert node.change(Transition.TRANSITION_CONFIGURE)
    assert node.state() == 'inactive'
    rig = Estimator(user, process, '/managed').listen()
    for _ in range(20):  # an inactive node takes no samples ...
        rig.send(0.2)
    for _ in range(2):
        rig.wait_status('state', STALE, 'inactive')
    assert not rig.estimates
    for y in (3.0, 5.0):
        assert node.change(Transition.TRANSITION_ACTIVATE)
        assert node.state() == 'active'
        assert rig.feed(y).z == [y, 0.0, 0.0]  # ... and an active one starts with its first
        assert rig.feed(y + 0.1).z != [y, 0.0, 0.0]
        rig.wait_status('state', OK, 'active')
        assert node.change(Transition.TRANSITION_DEACTIVATE)
        rig.wait_status('state', STALE, 'inactive')  # what was on its way has come
        ticks = len(rig.topics['stamp'])
        rig.wait_status('state', STALE, 'inactive')
        assert len(rig.topics['stamp']) == ticks
    assert rig.count('samples lost') == 0


def test_cleanup_leaves_nothing_behind(user, unconfigured):
    def entities() -> tuple[int, int, int]:
        heard = user.node.get_subscriptions_info_by_topic('/managed/y')
        return (
            user.node.count_publishers(f'{NODE}/state'),
            [info.node_name for info in heard].count('estimator'),
            user.node.count_services(f'{NODE}/reset'),
        )

    for _ in range(5):
        for transition in ('configure', 'activate', 'deactivate', 'cleanup'):
            assert unconfigured.change(transition)
    user.wait(lambda: entities() == (0, 0, 0), 'end of the topics')
    assert unconfigured.change('configure')
    user.wait(lambda: entities() == (1, 1, 1), 'one of each')


def test_the_model_is_read_when_it_is_configured(user, unconfigured, process):
    node, parameters = unconfigured, Parameters(user, NODE)
    was = parameters.all(['order', 'phi'])
    # One after the other, as `ros2 param set` does: between the two they do not fit together.
    parameters.set(order=2)
    assert not node.change('configure')
    assert node.state() == 'unconfigured'
    words = "transition configure failed: parameter 'phi': expected 2 expressions"
    assert words in process.output()
    parameters.set(phi=['0', '-z2'])
    assert node.change('configure')
    for name, value in was.items():
        result = parameters.try_to_set(**{name: value})
        assert not result.successful
        assert all(word in result.reason for word in (name, 'cleanup', 'got'))
        # Its own value is taken, as `ros2 param load` of its own file sets it.
        parameters.set(**{name: parameters.get(name)})
    assert node.change('activate')
    assert len(Estimator(user, process, '/managed').listen().feed(0.2).z) == 2
    assert node.change('deactivate')
    assert node.change('cleanup')
    parameters.set(**was)


@pytest.mark.parametrize('transition', [Transition.TRANSITION_ACTIVATE, 99, 'fly'])
def test_a_transition_that_is_not_possible_is_refused(unconfigured, process, transition):
    assert not unconfigured.change(transition)
    assert unconfigured.state() == 'unconfigured'
    assert f'transition {transition} is not possible while unconfigured' in process.output()


def test_reset_that_waits_during_cleanup_does_not_end_the_node(user, unconfigured, process):
    """The requests come while `cleanup` destroys their service."""
    change, cleanup = user.client(f'{NODE}/change_state', ChangeState), Transition(label='cleanup')
    for _ in range(3):
        assert unconfigured.change('configure')
        user.call(f'{NODE}/reset', Trigger)
        reset = user.client(f'{NODE}/reset', Trigger)
        change.call_async(ChangeState.Request(transition=cleanup))
        for _ in range(20):
            reset.call_async(Trigger.Request())
        user.wait(lambda: unconfigured.state() == 'unconfigured', 'cleanup')
        assert process.poll() is None


GRACE = 30.0
"""Seconds: one, and what a loaded machine adds."""


@pytest.mark.parametrize('signals', [['SIGHUP'], ['SIGTERM', 'SIGINT', 'SIGINT']], ids=len)
def test_running_pair_ends(user, launch, signals):
    """With requests that wait, so that callbacks run when the signal comes."""
    namespace = f'/end_{signals[0]}'
    topic = f'{namespace}/estimator/unknown_input'
    d = user.record(topic, Float64)
    nodes = [launch(name, namespace=namespace) for name in ('plant', 'estimator')]
    user.wait(lambda: len(d) > 10, 'estimates')
    parameters = Parameters(user, f'{namespace}/estimator')
    for _ in range(20):
        parameters.service.set_parameters([Parameter('variant', value='fuzzy')])
    for name in signals:
        for node in nodes:
            node.send_signal(signal.Signals[name])
    for node in nodes:
        assert node.wait(GRACE) == 0
    user.wait(lambda: user.node.count_publishers(topic) == 0, 'end of the publishers')


@pytest.mark.parametrize('transition', ['', 'configure', 'shutdown'])
def test_a_signal_ends_it_in_every_state(user, launch, transition):
    process = launch('estimator', namespace=f'/after_{transition}', autostart=False)
    manager = Manager(user, f'/after_{transition}/estimator')
    assert manager.state() == 'unconfigured'
    assert not transition or manager.change(transition)
    process.send_signal(signal.SIGINT)
    assert process.wait(GRACE) == 0


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
    assert process.wait(GRACE) == 0
    assert 'ended while a callback was running' in process.output()
