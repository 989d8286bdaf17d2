# SPDX-License-Identifier: Apache-2.0
"""Publishers that can't be heard are named; QoS of inputs and outputs can be chosen."""

import gc

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from fhaosmo_ros.nodes import plant  # noqa: E402
from fhaosmo_ros.nodes.estimator import node as estimator  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from rig import EstimatorRig, node_process, one_line_error, Parameters, parameters  # noqa: E402
from std_msgs.msg import Float64, Float64MultiArray, Int64  # noqa: E402

OK, WARN, ERROR, STALE = b'\0', b'\1', b'\2', b'\3'
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


@pytest.fixture(scope='module')
def stranger():
    """A node beside the test's client, as another process would have."""
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Node('stranger', context=context, use_global_arguments=False)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


@pytest.fixture
def listen(client, folder, request, stack):
    """Return a function that starts an estimator in a namespace of the test's own."""
    namespace = f'/{request.node.name}'

    def start(**values) -> EstimatorRig:
        arguments = parameters(namespace=namespace, **values)
        process = stack.enter_context(node_process(folder(), 'estimator', *arguments))
        rig = EstimatorRig(client, namespace, feed=False, gains=values.get('gains', 'fixed'))
        rig.topic, rig.process = f'{namespace}/y', process
        return rig

    return start


def test_no_publisher_is_said(listen):
    rig = listen()
    rig.wait_status('input', STALE, 'no usable sample yet', f'no publisher of {rig.topic}')


def test_publisher_with_clashing_qos_is_named(listen, stranger):
    rig = listen(input_reliability='reliable')
    publisher = stranger.create_publisher(Float64, rig.topic, BEST_EFFORT)
    words = ('/stranger', 'best effort publisher and reliable subscription', 'input_reliability')
    rig.wait_status('input', ERROR, *words)
    assert f'/stranger publishes {rig.topic} unheard' in rig.process.output
    assert rig.process.output.count('unheard') == 1  # once, not once a second
    stranger.destroy_publisher(publisher)
    rig.wait_status('input', STALE, 'no publisher')


def test_publisher_with_clashing_durability_is_named(listen, stranger):
    rig = listen(input_reliability='reliable', input_durability='transient_local')
    stranger.create_publisher(Float64, rig.topic, 10)
    rig.wait_status('input', ERROR, '/stranger', 'volatile', 'input_durability')


def test_publisher_of_another_type_is_named(listen, stranger):
    rig = listen()
    stranger.create_publisher(Int64, rig.topic, 10)
    rig.wait_status('input', ERROR, '/stranger', 'std_msgs/msg/Int64', 'std_msgs/msg/Float64')


def test_what_was_published_before_is_heard_if_asked_for(listen, stranger):
    namespace = '/test_what_was_published_before_is_heard_if_asked_for'
    publisher = stranger.create_publisher(Float64, f'{namespace}/y', LATCHED)
    publisher.publish(Float64(data=2.5))
    rig = listen(input_reliability='reliable', input_durability='transient_local', max_gap=60.0)
    assert rig.wait_estimate(lambda e: True, 'estimate of the latched sample').z[0] == 2.5


def test_two_publishers_and_a_change_of_publisher_are_said(client, listen, stranger):
    rig = listen(max_gap=60.0, publish_rate=200.0)
    first = stranger.create_publisher(Float64, rig.topic, 10)
    rig.wait_status('input', STALE, 'no usable sample yet')
    rig.client.wait(lambda: rig.value('publishers') == '/stranger', 'name of the publisher')
    second = client.publisher(rig.topic)
    rig.wait_status('input', STALE, '2 publishers')
    assert '2 publishers of' in rig.process.output
    for _ in range(20):
        first.publish(Float64(data=0.2))
    rig.client.wait(lambda: len(rig.y) >= 20, 'samples of the first')
    for _ in range(5):  # numbered from 1 on, below those of the first: nothing is lost
        rig.send = None
        second(0.2)
        first.publish(Float64(data=0.2))
    rig.wait_count('samples accepted', 25)
    assert rig.count('samples lost') == 0
    stranger.destroy_publisher(first)
    rig.client.wait(lambda: rig.value('publishers') == '/test_client', 'name of the other one')
    assert f'the publisher of {rig.topic} changed: now /test_client' in rig.process.output


def test_outputs_qos_can_be_overridden(client, listen):
    prefix = '/test_outputs_qos_can_be_overridden/estimator'
    rig = listen(**{
        f'qos_overrides.{prefix}/state.publisher.reliability': 'best_effort',
        f'qos_overrides.{prefix}/gamma.publisher.durability': 'transient_local',
    })  # fmt: skip
    infos = {
        topic: client.node.get_publishers_info_by_topic(f'{prefix}/{topic}')[0].qos_profile
        for topic in ('state', 'gamma', 'stamp')
    }
    assert infos['state'].reliability == ReliabilityPolicy.BEST_EFFORT
    assert infos['stamp'].reliability == ReliabilityPolicy.RELIABLE
    assert infos['gamma'].durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert infos['stamp'].durability == DurabilityPolicy.VOLATILE
    assert rig.parameters.get(f'qos_overrides.{prefix}/innovation.publisher.depth') == 1000


def test_who_comes_later_hears_the_latched_estimates_too(client, start):
    """An estimate that nobody listens to is not made, unless its publisher keeps the last ones."""
    name = '/test_who_comes_later/estimator'
    latched = {f'qos_overrides.{name}/gamma.publisher.durability': 'transient_local'}
    start('estimator', *parameters(namespace='/test_who_comes_later', **latched))
    stamps, publish = client.record(f'{name}/stamp', Time), client.publisher(f'{name[:-10]}/y')
    client.wait(lambda: publish(0.5) or len(stamps) > 10, 'estimates')
    before = stamps[-1].stamp
    gamma = client.record(f'{name}/gamma', Float64, LATCHED)
    state = client.record(f'{name}/state', Float64MultiArray)
    client.wait(lambda: publish(0.5) or (gamma and len(state) > 10), 'gamma and state')
    assert gamma[0].stamp < before < state[0].stamp


def test_topics_of_a_self_tuning_estimator_have_policies_too(listen):
    prefix = '/test_topics_of_a_self_tuning_estimator_have_policies_too/estimator'
    name = f'qos_overrides.{prefix}/standard_deviation.publisher.depth'
    rig = listen(gains='self_tuning', **{name: 7})
    assert rig.parameters.get(name) == 7


def test_outputs_of_the_plant_too(client, start):
    prefix = '/test_outputs_of_the_plant_too'
    policies = {
        f'qos_overrides.{prefix}/y.publisher.reliability': 'best_effort',
        f'qos_overrides.{prefix}/plant/state.publisher.depth': 7,
    }
    start('plant', *parameters(namespace=prefix, **policies))
    values = Parameters(client, f'{prefix}/plant')
    assert values.get(f'qos_overrides.{prefix}/plant/state.publisher.depth') == 7
    (y,) = client.node.get_publishers_info_by_topic(f'{prefix}/y')
    assert y.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT


def test_override_that_the_plant_does_not_have_is_refused(capfd):
    code = plant.main(['--ros-args', '-p', 'qos_overrides./yy.publisher.depth:=5'])
    gc.collect()
    assert code == 2
    message = one_line_error('plant', capfd.readouterr().err)
    assert "'qos_overrides./yy.publisher.depth': expected TOPIC" in message


@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('/estimator/state.publisher.reliability', 'sometimes', ['/estimator/state', 'sometimes']),
        ('/estimator/state.publisher.depth', 'deep', ['/estimator/state', 'deep']),
        ('/estimator/state.publisher.depth', '-1', ['/estimator/state', '-1']),
        ('/estimator/stat.publisher.depth', '5', ["'qos_overrides./estimator/stat", 'one of']),
        ('/estimator/state.publisher.deadline', '5', ['state.publisher.deadline', 'one of']),
    ],
)
def test_override_that_cannot_be_is_refused_in_one_line(name, value, words, capfd):
    code = estimator.main(['--ros-args', '-p', f'qos_overrides.{name}:={value}'])
    gc.collect()  # the node itself: two of one name in a process make rcl warn
    assert code == 2
    lines = capfd.readouterr().err.splitlines(keepends=True)
    ours = [line for line in lines if 'Publisher already registered' not in line]  # rcl's
    message = one_line_error('estimator', ''.join(ours))
    for word in words:
        assert word in message
