# SPDX-License-Identifier: Apache-2.0
"""The estimator as a managed node, driven through its services as `ros2 lifecycle` does."""

import signal

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rig import ESTIMATES, EstimatorRig, Manager, Parameters, parameters, Process  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402


@pytest.fixture(scope='module')
def node(client, start):
    process = start(
        'estimator',
        *parameters(namespace='/managed', autostart='false', publish_rate=100.0, max_gap=60.0),
    )
    manager = Manager(client, '/managed/estimator')
    manager.process = process
    manager.parameters = Parameters(client, '/managed/estimator')
    return manager


@pytest.fixture
def unconfigured(node):
    """Return the node in the state in which it started."""
    for state, transition in (('active', 'deactivate'), ('inactive', 'cleanup')):
        if node.state() == state:
            assert node.change(transition)
    assert node.state() == 'unconfigured'
    return node


def topics(client) -> int:
    return sum(client.node.count_publishers(f'/managed/estimator/{t}') for t in ESTIMATES)


def test_it_waits_and_has_neither_topics_nor_services(client, unconfigured):
    client.wait(lambda: topics(client) == 0, 'end of the topics')
    client.wait(
        lambda: client.node.count_subscribers('/managed/y') == 0, 'end of the subscription'
    )
    assert unconfigured.transitions() == {'configure', 'shutdown'}


def test_life_of_a_node(client, unconfigured):
    node = unconfigured
    assert node.change(Transition.TRANSITION_CONFIGURE)
    assert node.state() == 'inactive'
    rig = EstimatorRig(client, '/managed', greet=False)
    client.wait(lambda: rig._publish.matched() >= 2, 'subscription of y')
    rig.wait_status('state', b'\3', 'inactive')
    for _ in range(20):  # an inactive node takes no samples ...
        rig.send(0.2)
    reports = len(rig.diagnostics)
    client.wait(lambda: len(rig.diagnostics) > reports + 1, 'diagnostics')
    assert not rig.estimates
    assert node.change(Transition.TRANSITION_ACTIVATE)
    assert node.state() == 'active'
    assert rig.feed(3.0).z == [3.0, 0.0, 0.0]  # ... and an active one starts with its first
    assert rig.feed(3.1).z != [3.0, 0.0, 0.0]
    rig.wait_status('state', b'\0', 'active')
    assert node.change(Transition.TRANSITION_DEACTIVATE)
    assert node.state() == 'inactive'
    rig.wait_status('state', b'\3', 'inactive')  # what was on its way has come
    ticks = len(rig.topics['stamp'])
    rig.wait_status('state', b'\3', 'inactive')
    assert len(rig.topics['stamp']) == ticks
    assert node.change(Transition.TRANSITION_ACTIVATE)
    assert rig.feed(5.0).z == [5.0, 0.0, 0.0]
    assert rig.count('samples lost') <= 0
    assert node.change(Transition.TRANSITION_DEACTIVATE)
    assert node.change(Transition.TRANSITION_CLEANUP)
    assert node.state() == 'unconfigured'
    client.wait(lambda: topics(client) == 0, 'end of the topics')


def test_the_model_is_read_when_it_is_configured(client, unconfigured):
    node = unconfigured
    was = {name: node.parameters.get(name) for name in ('order', 'phi')}
    # One after the other, as `ros2 param set` does: between the two they do not fit together.
    for result in node.parameters.set(order=2, phi=['0', '-z2']):
        assert result.successful, result.reason
    assert node.change('configure')
    for name, value in was.items():
        (result,) = node.parameters.set(**{name: value})
        assert not result.successful
        for word in (name, 'cleanup', 'got'):
            assert word in result.reason
        (result,) = node.parameters.set(**{name: node.parameters.get(name)})
        assert result.successful, result.reason  # as `ros2 param load` of its own file does
    assert node.change('activate')
    state = client.record('/managed/estimator/state', ESTIMATES['state'])
    send = client.publisher('/managed/y')
    client.wait(lambda: send.matched() >= 1, 'subscription of y')

    def heard() -> bool:
        send(0.2)
        return bool(state)

    client.wait(heard, 'state')
    assert len(state[-1].message.data) == 2
    assert node.change('deactivate')
    assert node.change('cleanup')
    assert node.parameters.set_atomically(**was).successful


def test_parameters_that_do_not_fit_fail_the_transition_and_say_why(unconfigured):
    node = unconfigured
    (result,) = node.parameters.set(order=4)
    assert result.successful, result.reason
    assert not node.change('configure')
    assert node.state() == 'unconfigured'
    assert "transition configure failed: parameter 'phi': expected 4 expressions" in (
        node.process.output
    )
    (result,) = node.parameters.set(order=0)  # a value that is wrong by itself is refused at once
    assert not result.successful
    assert 'order' in result.reason
    assert node.parameters.set(order=3)[0].successful
    assert node.change('configure')


@pytest.mark.parametrize('transition', [Transition.TRANSITION_ACTIVATE, 99, 'activate', 'fly'])
def test_a_transition_that_is_not_possible_is_refused_and_does_no_harm(unconfigured, transition):
    node = unconfigured
    assert not node.change(transition)
    assert node.state() == 'unconfigured'
    assert f'transition {transition} is not possible while unconfigured' in node.process.output
    assert node.change('configure')
    assert not node.change('configure')
    assert node.state() == 'inactive'


def test_cycles_leave_nothing_behind(client, unconfigured):
    node = unconfigured
    for _ in range(5):
        for transition in ('configure', 'activate', 'deactivate', 'cleanup'):
            assert node.change(transition)
    for transition in ('configure', 'activate'):
        assert node.change(transition)
    client.wait(lambda: topics(client) == len(ESTIMATES), 'one publisher for each topic')

    def listeners() -> list[str]:
        found = client.node.get_subscriptions_info_by_topic('/managed/y')
        return [x.node_name for x in found if x.node_name != 'test_client']

    client.wait(lambda: listeners() == ['estimator'], 'one subscription')
    reset = '/managed/estimator/reset'
    client.wait(lambda: client.node.count_services(reset) == 1, 'one service')


def test_it_starts_by_itself(client, start):
    start('estimator', *parameters(namespace='/alone'))
    assert Manager(client, '/alone/estimator').state() == 'active'


@pytest.mark.parametrize(
    ('state', 'transitions'),
    [
        ('unconfigured', []),
        ('inactive', ['configure']),
        ('active', ['configure', 'activate']),
        ('finalized', ['shutdown']),
    ],
)
def test_a_signal_ends_it_in_every_state(client, folder, state, transitions):
    namespace = f'/end_{state}'
    process = Process(folder(), 'estimator', *parameters(namespace=namespace, autostart='false'))
    try:
        node = Manager(client, f'{namespace}/estimator')
        client.wait(lambda: 'waiting to be configured' in process.output, 'start')
        for transition in transitions:
            assert node.change(transition)
        assert node.state() == state
        process.send(signal.SIGINT)
        assert process.wait() == 0
        for word in ('Traceback', 'rror'):
            assert word not in process.output, process.output
    finally:
        process.kill()


def test_reset_that_waits_during_cleanup_does_not_end_the_node(client, node, unconfigured):
    """The requests come while `cleanup` destroys their service."""
    change, reset = '/managed/estimator/change_state', '/managed/estimator/reset'
    cleanup = ChangeState.Request(transition=Transition(label='cleanup'))
    for _ in range(3):
        assert node.change('configure')
        client.call(reset, Trigger, Trigger.Request())
        client.call_later(change, ChangeState, cleanup)
        for _ in range(20):
            client.call_later(reset, Trigger, Trigger.Request(), wait=False)
        client.wait(lambda: node.state() == 'unconfigured', 'cleanup')
        assert node.process.running
