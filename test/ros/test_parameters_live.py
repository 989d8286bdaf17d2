# SPDX-License-Identifier: Apache-2.0
"""Parameters of running nodes: described, set, refused."""

import math

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, PLANT_NODE_PARAMETERS
import numpy as np
import pytest
from yaml_texts import HOSTILE, random_texts

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from fhaosmo_ros.nodes.middleware.parameters import TYPES  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter as RosParameter  # noqa: E402
from rig import EstimatorRig, Parameters, parameters  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402

TABLES = {'estimator': ESTIMATOR_PARAMETERS, 'plant': PLANT_NODE_PARAMETERS}

STARTED_WITH = {
    'estimator': {
        'publish_rate': 200.0,
        'max_gap': 60.0,
        'gamma_min': 0.3,
        'gamma_max': 0.8,
        'gamma_initial': 0.5,
    },
    'plant': {'sample_rate': 200.0},
}

OTHER = {
    'unknown_input_decay': 2.0,
    'bandwidth': 2.0,
    'tuning_memory': 4.0,
    'structure': 'levant',
    'variant': 'fuzzy',
    'scheme': 'explicit',
    'prediction_step': 0.002,
    'correction_period': 0.001,
    'noise_size': 0.001,
    'state_sizes': [2.0],
    'unknown_input_size': 2.0,
    'unknown_input_rate': 2.0,
    'lambda': [12.0, 13.0, 14.0, 16.0],
    'alpha': [20.0, 25.0, 30.0, 35.0],
    'epsilon': 0.05,
    'fuzzy_widths': [0.03, 0.01],
    'fuzzy_systems': ['terms 5; output singleton 5', 'curve 0 0.8 1'],
    'gamma_initial': 0.6,
    'gamma_rate': 0.01,
    'gamma_min': 0.45,
    'gamma_max': 0.7,
    'gamma_dead_zone': 0.01,
    'gamma_leakage': 0.1,
    'initial_estimate': [0.1, 0.0, 0.0, 0.0],
    'initial_internal': [0.1, 0.0, 0.0, 0.0],
    'start_from_measurement': False,
    'estimate_from': 'filtered',
    'sampling': 'nominal',
    'nominal_period': 0.002,
    'max_gap': 50.0,
    'max_step': 0.01,
    'spike_gate': 10.0,
    'stuck_time': 100.0,
    'divergence_time': 5.0,
    'divergence_limit': 1e9,
    'predict_to_now': True,
    'event_threshold': 1e6,
    'event_deviations': 4.0,
    'event_duration': 0.2,
    'event_release': 0.7,
    'event_change_time': 3.0,
    'publish_rate': 250.0,
    'diagnostics_period': 0.5,
    'hardware_id': 'encoder',
    'publish_on': 'sample',
    'measurement_unit': 'rad',
    'unknown_input_scale': -2.5,
    'unknown_input_unit': 'N m',
    'warn_rate_below': 1.0,
    'warn_jitter_above': 0.4,
    'warn_delay_above': 0.2,
    'warn_chatter_above': 1e9,
    'error_bad_share_above': 0.1,
    'disturbance': 'square',
    'disturbance_amplitude': 0.2,
    'disturbance_omega': 2.0,
    'disturbance_offset': -0.1,
    'disturbance_start': 2.0,
    'noise_std': 0.001,
    'quantisation': 0.002,
    'noise_seed': 7,
    'sample_rate': 300.0,
}
"""A valid value for every live parameter, different from the one the node starts with."""

READ_ONLY = {
    'estimator': ['autostart', 'channels'],  # the rest can be set while the node is unconfigured
    'plant': [name for name, p in PLANT_NODE_PARAMETERS.items() if not p.live],
}
SLIDERS = {
    'estimator': [
        'order', 'unknown_input_derivatives', 'bandwidth', 'gamma_initial', 'gamma_min',
        'gamma_max', 'event_release', 'publish_rate', 'input_depth',
        'diagnostics_period', 'error_bad_share_above',
    ],
    'plant': ['order', 'sample_rate'],
}  # fmt: skip
"""Numbers whose bounds are a range to choose from; the others' only keep out nonsense."""
SIGNED = {
    'unknown_input_scale',
    'initial_estimate', 'initial_internal', 'initial_state', 'disturbance_amplitude',
    'disturbance_offset',
}  # fmt: skip
LIVE = {node: [name for name, p in table.items() if p.live] for node, table in TABLES.items()}


@pytest.fixture(scope='module')
def rig(client, start):
    """An estimator fed by the test; no gap restarts it while the tests talk to its services."""
    process = start('estimator', *parameters(**STARTED_WITH['estimator']))
    rig = EstimatorRig(client)
    rig.process = process
    return rig


@pytest.fixture(scope='module')
def nodes(client, start, rig):
    """The parameter services of both nodes."""
    # In a namespace: the rig's estimator must not hear this plant.
    start('plant', *parameters(namespace='/other', **STARTED_WITH['plant']))
    return {'estimator': rig.parameters, 'plant': Parameters(client, '/other/plant')}


@pytest.mark.parametrize('node', TABLES)
def test_every_parameter_is_listed_and_described(nodes, node):
    table = TABLES[node]
    names = nodes[node].names()
    assert set(table) <= names
    extra = {n for n in names - set(table) if not n.startswith('qos_overrides.')}
    assert extra <= {'use_sim_time', 'start_type_description_service'}
    described = nodes[node].describe(*table)
    for name, parameter in table.items():
        d = described[name]
        assert len(d.description) > 10, name
        assert d.type == TYPES[parameter.kind].value, name
        assert d.read_only == (name in READ_ONLY[node]), name
        assert parameter.allowed in d.additional_constraints, name
        ranges = [*d.floating_point_range, *d.integer_range]
        assert len(ranges) == (name in SLIDERS[node]), name
        for r in ranges:
            assert (r.from_value, r.to_value) == (parameter.lower, parameter.upper), name
            assert (r.to_value - r.from_value) / 100 <= max(1.0, abs(parameter.default)), name
        logarithmic = 'logarithmic scale' in d.additional_constraints
        assert logarithmic == (
            parameter.kind.startswith('double')
            and name not in SLIDERS[node]
            and name not in SIGNED
        ), name
        fixed = not parameter.live and name not in READ_ONLY[node]
        assert ('set it after cleanup' in d.additional_constraints) == fixed, name


@pytest.mark.parametrize('node', TABLES)
def test_values_are_the_declared_defaults_in_their_types(nodes, node):
    for name, parameter in TABLES[node].items():
        expected = STARTED_WITH[node].get(name, parameter.default)
        value = nodes[node].get(name)
        assert value == expected, name
        assert type(value) is type(expected), name


@pytest.mark.parametrize('node', TABLES)
@pytest.mark.parametrize('name', ['order', 'phi'])
def test_the_model_is_read_only(nodes, node, name):
    before = nodes[node].get(name)
    (result,) = nodes[node].set(**{name: 2 if name == 'order' else ['0', '0', 'z1']})
    assert not result.successful
    assert name in result.reason
    assert nodes[node].get(name) == before


def test_constants_are_parameters_of_their_own(client, start):
    model = {'order': 2, 'phi': "['0', 'k*a + b']", 'inputs': "['a', 'b']"}
    start('estimator', *parameters(namespace='/motor', **model, **{'constants.k': 2.0}))
    node = Parameters(client, '/motor/estimator')
    assert node.get('constants.k') == 2.0
    assert 'Phi' in node.describe('constants.k')['constants.k'].description
    for topic in ('/motor/a', '/motor/b'):
        client.wait(
            lambda t=topic: client.node.count_subscribers(t) == 1, f'subscription of {topic}'
        )
    (result,) = node.set(**{'constants.k': 3})
    assert result.successful
    assert node.get('constants.k') == 3.0
    for bad in ({'constants.k': math.nan}, {'constants.k': 'x'}, {'constants.q': 1.0}):
        (result,) = node.set(**bad)
        assert not result.successful
        assert next(iter(bad)) in result.reason
    assert node.get('constants.k') == 3.0


def _settle(rig) -> None:
    """Bring the observer near a constant measurement."""
    for _ in range(15):
        rig.feed(0.2)


# event_deviations needs self-tuning: test_online_parameters.py, test_events.py
@pytest.mark.parametrize('name', [n for n in LIVE['estimator'] if n != 'event_deviations'])
def test_every_live_parameter_of_the_estimator_changes_without_a_jump(rig, name):
    p = rig.parameters
    _settle(rig)
    was = p.get(name)
    assert was != OTHER[name]
    before = rig.feed(0.2)
    restarts = max(rig.count('restarts'), 0)  # -1 before the first report
    for value in (OTHER[name], was):
        (result,) = p.set(**{name: value})
        assert result.successful, result.reason
        assert p.get(name) == value
        after = rig.feed(0.2)
        # One step of the recursion moves a state by no more than its right-hand side allows:
        # lambda |eps|^gamma + |z| and alpha, times the time that has passed.
        dt = (after.stamp - before.stamp) * 1e-9
        eps = max(map(abs, [*before.innovation, *after.innovation]))
        slope = 16.0 * max(eps, eps**0.3) + 35.0 + max(map(abs, before.z)) + 1.0
        bound = dt * slope
        if name == 'estimate_from':  # it selects another variable, equal where both have settled
            bound += eps
        np.testing.assert_allclose(after.z, before.z, rtol=0.0, atol=bound)
        assert abs(after.unknown_input - before.unknown_input) <= bound
        assert all(map(math.isfinite, [*after.z, after.unknown_input, after.gamma]))
        before = after
    assert max(rig.count('restarts'), 0) == restarts


def test_a_change_acts_on_the_next_sample_as_in_a_replay(rig):
    rig.reset()
    online = {n: v for n, v in STARTED_WITH['estimator'].items() if n != 'publish_rate'}
    replay = OnlineEstimator(online)
    changes = {5: {'lambda_': [20.0]}, 10: {'scheme': 'explicit'}, 15: {'variant': 'sign'}}
    for k in range(30):
        if k in changes:
            (result,) = rig.parameters.set(**changes[k])
            assert result.successful, result.reason
            replay.configure({n.rstrip('_'): v for n, v in changes[k].items()})
        y = 0.2 + 0.1 * math.sin(0.1 * k)
        estimate = rig.feed(y)
        expected = replay.update(estimate.stamp, y)
        np.testing.assert_allclose(estimate.z, expected.z, rtol=0.0, atol=1e-12)
        assert estimate.gamma == pytest.approx(expected.gamma, abs=1e-12)
    defaults = {n: ESTIMATOR_PARAMETERS[n].default for n in ('lambda', 'scheme', 'variant')}
    assert rig.parameters.set_atomically(**defaults).successful


@pytest.mark.parametrize('name', LIVE['plant'])
def test_every_live_parameter_of_the_plant_can_change(nodes, name):
    p = nodes['plant']
    was = p.get(name)
    for value in (OTHER[name], was):
        (result,) = p.set(**{name: value})
        assert result.successful, result.reason
        assert p.get(name) == value


REJECTED = [
    ('gamma_min', -0.1, ['0', '1', '-0.1']),
    ('gamma_min', 0.0, ['> 0', '0.0']),
    ('gamma_min', 0.9, ['gamma_max', '0.9']),
    ('gamma_max', 0.1, ['gamma_min', '0.1']),
    ('gamma_rate', math.nan, ['0', 'nan']),
    ('epsilon', math.inf, ['0', 'inf']),
    ('epsilon', 'wide', ['a number', "'wide'"]),
    ('epsilon', True, ['a number', 'True']),
    ('variant', 'fuzy', ['sign, fuzzy, fuzzy_adaptive', "'fuzy'", "did you mean 'fuzzy'?"]),
    ('scheme', 3, ['explicit, implicit', '3']),
    ('lambda', [15.0, 15.0], ['1 or 4', '[15.0, 15.0]']),
    ('lambda', [15.0, 15.0, 15.0, math.nan], ['numbers > 0', 'nan']),
    ('lambda', [15.0, -1.0, 15.0, 15.0], ['numbers > 0', '-1.0']),
    ('alpha', [1.0] * 5, ['1 or 4', '[1.0, 1.0, 1.0, 1.0, 1.0]']),
    ('fuzzy_widths', [0.1] * 5, ['4', '[0.1, 0.1, 0.1, 0.1, 0.1]']),
    ('fuzzy_systems', ['terms 5; rules 5 4 3 2 1'], ['does not fall', 'rules 5 4 3 2 1']),
    ('unknown_input', 1, ['true or false', '1']),
    ('publish_rate', 0.0, ['0.1', '5000', '0.0']),
    ('publish_rate', 1e6, ['0.1', '5000', '1000000.0']),
    ('max_gap', 'soon', ['a number', "'soon'"]),
]


@pytest.mark.parametrize(('name', 'value', 'words'), REJECTED)
def test_bad_value_changes_nothing_and_says_why(rig, name, value, words):
    p = rig.parameters
    before = p.messages(*ESTIMATOR_PARAMETERS)
    (result,) = p.set(**{name: value})
    assert not result.successful
    assert '\n' not in result.reason
    for word in [name, *words]:
        assert word in result.reason, result.reason
    assert p.messages(*ESTIMATOR_PARAMETERS) == before
    described = p.describe(name)[name]
    assert described.type == TYPES[ESTIMATOR_PARAMETERS[name].kind].value


@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('noise_std', -1.0, ['0', '-1.0']),
        ('noise_seed', 1.5, ['an integer', '1.5']),
        ('noise_seed', -1, ['0', '-1']),
        ('disturbance', 'saw', ['none, sine, step, square, chirp', "'saw'"]),
        ('disturbance_amplitude', math.nan, ['nan']),
        ('sample_rate', 1e5, ['5000', '100000.0']),
    ],
)
def test_bad_value_of_the_plant_changes_nothing_and_says_why(nodes, name, value, words):
    p = nodes['plant']
    before = p.messages(*PLANT_NODE_PARAMETERS)
    (result,) = p.set(**{name: value})
    assert not result.successful
    for word in [name, *words]:
        assert word in result.reason, result.reason
    assert p.messages(*PLANT_NODE_PARAMETERS) == before


def test_rejected_values_leave_the_estimate_alone(rig):
    _settle(rig)
    before = rig.feed(0.2)
    rig.parameters.set(gamma_min=0.9, lambda_=[1.0, 2.0], variant='x')
    after = rig.feed(0.2)
    dt = (after.stamp - before.stamp) * 1e-9
    np.testing.assert_allclose(after.z, before.z, rtol=0.0, atol=60.0 * dt)


@pytest.mark.parametrize(
    ('name', 'text', 'value'),
    [
        ('epsilon', '4', 4.0),
        ('epsilon', '1e-2', 0.01),
        ('lambda', '[15, 15, 15, 15]', [15.0] * 4),
        ('lambda', '[15, 15.5, 16, 17]', [15.0, 15.5, 16.0, 17.0]),
        ('lambda', '[15, 1e1, 16.5, 17]', [15.0, 10.0, 16.5, 17.0]),
        ('lambda', '14', [14.0]),
        ('lambda', '14.5', [14.5]),
        ('start_from_measurement', 'off', False),
        ('variant', 'sign', 'sign'),
    ],
)
def test_values_as_ros2_param_set_sends_them(rig, name, text, value):
    p = rig.parameters
    was = p.get(name)
    result = p.set_text(name, text)
    assert result.successful, result.reason
    assert p.get(name) == value
    assert type(p.get(name)) is type(ESTIMATOR_PARAMETERS[name].default)
    assert p.describe(name)[name].type == TYPES[ESTIMATOR_PARAMETERS[name].kind].value
    assert p.set(**{name: was})[0].successful


@pytest.mark.parametrize('text', ['[]', '[a, 1]', '[[1, 2], [3, 4]]', '[1, 2', ''])
def test_odd_texts_are_refused_for_a_list(rig, text):
    result = rig.parameters.set_text('lambda', text)
    assert not result.successful
    assert "parameter 'lambda': expected a list of numbers > 0" in result.reason


@pytest.mark.parametrize('name', ['lambda', 'epsilon', 'fuzzy_widths'])
def test_whatever_the_text_is_the_answer_is_one_line(rig, name):
    before = rig.parameters.messages(*ESTIMATOR_PARAMETERS)
    texts = [*HOSTILE.values(), *random_texts(200)]
    for text in texts:
        message = RosParameter(name, value=text).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        (result,) = rig.client.call('/estimator/set_parameters', SetParameters, request).results
        assert not result.successful, text
        assert f"parameter '{name}': expected " in result.reason
        assert result.reason.isprintable()
        assert len(result.reason) < 300
    assert rig.parameters.messages(*ESTIMATOR_PARAMETERS) == before
    assert rig.process.running
    assert math.isfinite(rig.feed(0.2).z[0])


def test_a_parameter_cannot_be_deleted(rig):
    request = SetParameters.Request(parameters=[Parameter(name='lambda', value=ParameterValue())])
    answer = rig.client.call('/estimator/set_parameters', SetParameters, request)
    assert not answer.results[0].successful
    assert 'lambda' in rig.parameters.names()


def test_unknown_parameter_is_refused(rig):
    (result,) = rig.parameters.set(lamda=1.0)
    assert not result.successful
    assert "'lamda'; did you mean 'lambda'?" in result.reason


def test_atomic_set_is_all_or_nothing(rig):
    p = rig.parameters
    before = p.messages(*ESTIMATOR_PARAMETERS)
    result = p.set_atomically(epsilon=0.04, lambda_=[1.0, 2.0])
    assert not result.successful
    assert 'lambda' in result.reason
    assert p.messages(*ESTIMATOR_PARAMETERS) == before
    # Each would be refused alone, beside the other's old value.
    result = p.set_atomically(gamma_min=0.85, gamma_max=0.95, gamma_initial=0.9)
    assert result.successful, result.reason
    assert (p.get('gamma_min'), p.get('gamma_max')) == (0.85, 0.95)
    assert rig.feed(0.2).gamma >= 0.85
    assert p.set_atomically(gamma_min=0.3, gamma_max=0.8, gamma_initial=0.5).successful


def _wait_period(client, messages: list, period: float) -> None:
    """Wait until messages come at this period; now and then a machine under load stalls."""
    start = len(messages)

    def there() -> bool:
        stamps = [m.stamp for m in messages[start:][-20:]]
        return len(stamps) == 20 and np.median(np.diff(stamps)) * 1e-9 == pytest.approx(
            period, rel=0.2
        )

    client.wait(there, f'period of {period} s')


def test_publish_rate_acts_on_the_wire(rig):
    rig.feed(0.2)
    assert rig.parameters.set(publish_on='timer')[0].successful
    for rate in (20.0, 100.0):
        (result,) = rig.parameters.set(publish_rate=rate)
        assert result.successful
        _wait_period(rig.client, rig.topics['stamp'], 1.0 / rate)
    assert rig.parameters.set(publish_rate=200.0)[0].successful


def test_sample_rate_acts_on_the_wire(nodes, client):
    y = client.record('/other/y', Float64)
    for rate in (50.0, 100.0):
        assert nodes['plant'].set(sample_rate=rate)[0].successful
        _wait_period(client, y, 1.0 / rate)
