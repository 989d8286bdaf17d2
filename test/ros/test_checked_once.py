# SPDX-License-Identifier: Apache-2.0
"""Each value is checked once, each channel has one estimator."""

from collections import Counter

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters import declaration
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from fhaosmo_ros.nodes.estimator.node import EstimatorNode  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402

OVERRIDES = {'epsilon': 0.3, 'lambda': [15, 15, 15, 15], 'max_gap': 60.0}
CHANNELS = {'channels': ['hip', 'knee'], 'epsilon': 0.3, 'hip.epsilon': 0.4}


@pytest.fixture
def counts(monkeypatch):
    """Count coercions by the parameter's name, and estimators and preparations by their class."""
    found = Counter()

    def counting(owner, name, label):
        method = getattr(owner, name)

        def counted(self, *arguments):
            found[label(self)] += 1
            return method(self, *arguments)

        monkeypatch.setattr(owner, name, counted)

    counting(declaration.Parameter, 'coerce', lambda parameter: parameter.name)
    counting(OnlineEstimator, '__init__', lambda _: 'estimators')
    counting(OnlineEstimator, 'prepare', lambda _: 'prepared')
    return found


@pytest.fixture
def start():
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    nodes = []

    def start(overrides):
        parameters = [Parameter(name, value=value) for name, value in overrides.items()]
        node = EstimatorNode(
            context=context, use_global_arguments=False, parameter_overrides=parameters
        )
        nodes.append(node)
        return node

    yield start
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)


@pytest.mark.parametrize(
    ('overrides', 'estimators'),
    [(OVERRIDES, 1), ({**OVERRIDES, 'autostart': False}, 1), (CHANNELS, 2)],
)
def test_start_coerces_each_value_once(overrides, estimators, counts, start):
    start(overrides)
    coerced = dict.fromkeys(['channels', *overrides], 1)
    assert counts == {**coerced, 'estimators': estimators}


def test_live_change_is_coerced_and_prepared_once(counts, start):
    node = start(OVERRIDES)
    counts.clear()
    assert node.set_parameters([Parameter('epsilon', value=2)])[0].successful
    assert counts == {'epsilon': 1, 'prepared': 1}
    assert node.get_parameter('epsilon').value == 2.0
    counts.clear()
    assert not node.set_parameters([Parameter('epsilon', value=-1.0)])[0].successful
    assert counts == {'epsilon': 1}


def test_live_change_of_channels_is_prepared_once_in_each(counts, start):
    node = start(CHANNELS)
    counts.clear()
    assert node.set_parameters([Parameter('epsilon', value=0.5)])[0].successful
    assert counts == {'epsilon': 1, 'prepared': 2}
    values = [node.get_parameter(f'{name}.epsilon').value for name in ('hip', 'knee')]
    assert values == [0.4, 0.5]


def test_warm_up_leaves_no_trace(start):
    estimator = start(OVERRIDES)._channels.channels[0].estimator
    fresh = OnlineEstimator(OVERRIDES)
    assert estimator.counters == fresh.counters
    assert estimator.estimate is None
    assert repr(estimator.state_dict()) == repr(fresh.state_dict())


def test_change_acts_on_the_channel(start):
    """What ROS has, the node and its estimator have too."""
    node = start(OVERRIDES)
    channel = node._channels.channels[0]
    changes = {'epsilon': 2.0, 'max_gap': 5.0, 'publish_rate': 50.0, 'sampling': 'clock'}
    parameters = [Parameter(name, value=value) for name, value in changes.items()]
    assert node.set_parameters_atomically(parameters).successful
    assert {name: node._node_parameters.values[name] for name in changes} == changes
    for name in ('epsilon', 'max_gap', 'sampling'):
        assert channel.estimator.parameters[name] == changes[name]
    assert node._channels._timer.timer_period_ns == 20_000_000
    channel._on_sample(10**18, 0.2, 10**18)
    assert channel.estimator.stamp != 10**18
