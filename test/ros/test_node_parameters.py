# SPDX-License-Identifier: Apache-2.0
"""Parameters of running nodes: described, told, set, refused, and what a change does."""

import math

from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, PLANT_NODE_PARAMETERS
import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rclpy.parameter import get_parameter_value
from running import FED

TABLES = {'estimator': ESTIMATOR_PARAMETERS, 'plant': PLANT_NODE_PARAMETERS}
STARTED_WITH = {'estimator': FED, 'plant': {'sample_rate': 200.0}}
READ_ONLY = {
    'estimator': ['autostart', 'channels'],  # the rest can be set while the node is unconfigured
    'plant': [p.name for p in PLANT_NODE_PARAMETERS.values() if not p.live],
}


@pytest.fixture
def nodes(fed, pair):
    """Return the parameters of both nodes."""
    return {'estimator': fed.parameters, 'plant': pair.plant}


@pytest.mark.parametrize('node', TABLES)
def test_every_parameter_is_described_and_has_its_default(nodes, node):
    table, parameters = TABLES[node], nodes[node]
    names = parameters.ask('list_parameters').result.names
    extra = {name for name in names if not name.startswith('qos_overrides.')} - set(table)
    assert extra <= {'use_sim_time', 'start_type_description_service'}
    assert parameters.all(table) == table.defaults() | STARTED_WITH[node]
    types = [message.type for message in parameters.messages(*table)]
    described = parameters.ask('describe_parameters', list(table)).descriptors
    for kind, d, p in zip(types, described, table.values(), strict=True):
        assert d.name == p.name
        assert (d.description, d.type) == (p.text, kind), p.name
        assert d.read_only == (p.name in READ_ONLY[node]), p.name
        assert p.allowed in d.additional_constraints, p.name
        fixed = not p.live and not d.read_only
        assert ('set it after cleanup' in d.additional_constraints) == fixed, p.name


@pytest.mark.parametrize(('node', 'name', 'value', 'words'), [
    ('estimator', 'gamma_min', 0.97, ['gamma_initial', '0.97']),
    ('estimator', 'variant', 'fuzy', ["'fuzy'", "did you mean 'fuzzy'?"]),
    ('estimator', 'lambda', [15.0, 15.0], ['1 or 4', '[15.0, 15.0]']),
    ('estimator', 'order', 2, ['cleanup', '2']),
    ('estimator', 'epsilon', math.nan, ['expected', 'nan']),
    ('estimator', 'lamda', 1.0, ["did you mean 'lambda'?"]),
    ('plant', 'noise_seed', 1.5, ['an integer', '1.5']),
    ('plant', 'phi', ['0', '0', 'z1'], []),
])  # fmt: skip
def test_bad_value_changes_nothing_and_says_why(nodes, node, name, value, words):
    parameters = nodes[node]
    before = parameters.messages(*TABLES[node])
    result = parameters.try_to_set(**{name: value})
    assert not result.successful
    assert '\n' not in result.reason
    assert not [word for word in [name, *words] if word not in result.reason], result.reason
    assert parameters.messages(*TABLES[node]) == before


def test_a_set_is_judged_as_a_whole(fed):
    """The last one would be refused alone, beside the other's old value."""
    fed.parameters.set(gamma_min=0.01, gamma_initial=0.05)
    fed.reset()
    assert fed.feed(0.2).gamma == 0.05


@pytest.mark.parametrize(('name', 'text', 'value'), [
    ('epsilon', '1e-2', 0.01),
    ('lambda', '[15, 1e1, 16.5, 17]', [15.0, 10.0, 16.5, 17.0]),
    ('lambda', '14.5', [14.5]),
    ('start_from_measurement', 'off', False),
    ('lambda', '[a, 1]', None),
])  # fmt: skip
def test_texts_as_ros2_param_set_sends_them(fed, name, text, value):
    p = fed.parameters
    kind = p.messages(name)[0].type

    def try_to_set(value: ParameterValue):
        return p.ask('set_parameters', [Parameter(name=name, value=value)]).results[0]

    result = try_to_set(get_parameter_value(text))
    assert result.successful == (value is not None), result.reason
    if value is None:
        assert f"parameter '{name}': expected a list of numbers > 0" in result.reason
    else:
        assert p.get(name) == value
    assert not try_to_set(ParameterValue()).successful  # as `ros2 param delete`
    assert p.messages(name)[0].type == kind
