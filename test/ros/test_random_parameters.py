# SPDX-License-Identifier: Apache-2.0
"""Two thousand random sets of parameters: none of them hurts, each refusal has its reason."""

import math

from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import numpy as np
from observer_cases import SYSTEMS
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from fhaosmo_ros.nodes.estimator.node import EstimatorNode  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402

COUNT = 2_000
LIVE = {name: p for name, p in ESTIMATOR_PARAMETERS.items() if p.live}
FIXED = [name for name in ESTIMATOR_PARAMETERS if name not in LIVE]
ODD = (
    math.nan, math.inf, -math.inf, -1.0, 0.0, 1e308, -1e308, 5e-324, 2**62, -1, True, '', 'fuzzy',
    '[1.0, 2.0]', '1e-3', "__import__('os').abort()", '!!python/name:os.abort', [1.0, math.nan],
    [0.5] * 4, [0.5] * 13, ['0', '0'], [1, 2, 3, 4], [True], 'x' * 10_000,
)  # fmt: skip


@pytest.fixture(scope='module')
def node():
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = EstimatorNode(context=context, use_global_arguments=False)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def number(rng, parameter) -> float:
    """Return a number within the bounds, of any magnitude."""
    low = parameter.lower if parameter.lower is not None else -1e6
    high = parameter.upper if parameter.upper is not None else 1e6
    value = 10.0 ** rng.uniform(-6.0, 6.0) * (rng.choice([-1.0, 1.0]) if low < 0.0 else 1.0)
    return float(np.clip(value, max(low, low + 1e-9), high))


def valid(rng, parameter) -> object:
    if parameter.choices:
        return str(rng.choice(parameter.choices))
    match parameter.kind:
        case 'bool':
            return bool(rng.integers(2))
        case 'int':
            return int(rng.integers(parameter.lower, min(parameter.upper, 2**31) + 1))
        case 'double':
            return number(rng, parameter)
        case 'string':
            return 'any'
        case 'string_array':  # fuzzy_systems
            return rng.choice([*SYSTEMS, 'terms 4'], rng.integers(1, 4)).tolist()
    return [number(rng, parameter) for _ in range(rng.choice([1, 4]))]


def test_random_sets(node):
    rng = np.random.default_rng(5)
    channel = node._channels.channels[0]
    stamp, accepted, refused = 10**18, 0, 0
    for k in range(COUNT):
        names = rng.choice([*LIVE, *FIXED[:2]], size=rng.integers(1, 4), replace=False)
        values = {
            str(name): ODD[rng.integers(len(ODD))] if rng.random() < 0.15
            else valid(rng, ESTIMATOR_PARAMETERS[name])
            for name in names
        }  # fmt: skip
        before = {name: node.get_parameter(name).value for name in ESTIMATOR_PARAMETERS}
        result = node.set_parameters_atomically([Parameter(n, value=v) for n, v in values.items()])
        after = {name: node.get_parameter(name).value for name in ESTIMATOR_PARAMETERS}
        if result.successful:
            accepted += 1
            assert {n for n in after if after[n] != before[n]} <= set(values), values
        else:
            refused += 1
            assert after == before, values
            assert result.reason, values
            assert '\n' not in result.reason, result.reason
            assert any(name in result.reason for name in [*values, 'gamma_']), (values, result)
        for _ in range(2):
            stamp += int(rng.choice([1_000, 1_000_000, 20_000_000]))
            y = rng.normal() if rng.random() < 0.99 else rng.choice([math.nan, 1e300])
            channel._on_sample(stamp, float(y), stamp)
        estimate = channel.estimator.estimate
        if estimate is not None:
            numbers = [*estimate.z, estimate.unknown_input, estimate.gamma, *estimate.innovation]
            assert all(map(math.isfinite, numbers)), (k, values)
            assert 0.0 < estimate.gamma <= 1.0
    assert min(accepted, refused) > COUNT // 10
