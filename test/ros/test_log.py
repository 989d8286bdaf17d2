# SPDX-License-Identifier: Apache-2.0
"""What is logged, how often, and from which level on."""

import math
import re

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from fhaosmo_ros.nodes.estimator import channel as channel_module  # noqa: E402
from fhaosmo_ros.nodes.estimator.node import EstimatorNode  # noqa: E402
from rcl_interfaces.msg import LoggerLevel  # noqa: E402
from rcl_interfaces.srv import SetLoggerLevels  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from rig import Parameters, parameters  # noqa: E402
from waiting import wait_until  # noqa: E402


@pytest.fixture
def node():
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    overrides = [Parameter('max_gap', value=0.001)]
    node = EstimatorNode(
        context=context, use_global_arguments=False, parameter_overrides=overrides
    )
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_a_slow_sensor_gets_one_warning_of_each_kind(node, capfd, monkeypatch):
    """Each sample comes long after max_gap; without a limit two warnings a sample are logged."""
    monkeypatch.setattr(channel_module, 'QUIET', 3600.0)
    channel = node._channels.channels[0]
    said = ''
    for k in range(1, 11):
        channel._on_sample(k * 10**9, math.nan if k == 6 else 0.2, k * 10**9)
        channel.publish()
        wait_until(lambda: channel.is_stale(), 'silence')
        said += capfd.readouterr().err
    warnings = re.findall(r'\[WARN\] .*?: (.{22})', said)
    assert sorted(warnings) == [
        'no usable sample on /y',
        'rejected a sample: exp',  # ected a finite y
        'rejected a sample: its',  # stamp lies more than max_gap
        'the stamps jumped by m',
    ]


@pytest.mark.parametrize('name', ['estimator', 'plant'])
def test_levels_of_the_log_can_be_set(client, start, name):
    process = start(name, *parameters(namespace='/log'))
    values = Parameters(client, f'/log/{name}')
    parameter = {'estimator': 'epsilon', 'plant': 'noise_std'}[name]

    def set_level(level: int) -> None:
        levels = [LoggerLevel(name=f'log.{name}', level=level)]
        request = SetLoggerLevels.Request(levels=levels)
        (result,) = client.call(f'/log/{name}/set_logger_levels', SetLoggerLevels, request).results
        assert result.successful

    set_level(LoggerLevel.LOG_LEVEL_WARN)
    assert values.set(**{parameter: 0.5})[0].successful
    set_level(LoggerLevel.LOG_LEVEL_INFO)
    assert values.set(**{parameter: 0.25})[0].successful
    wait_until(lambda: '= 0.25' in process.output, 'word of the change')
    assert '= 0.5' not in process.output
