# SPDX-License-Identifier: Apache-2.0
"""Every declared parameter, by the rules that all of them share; and those of many channels."""

import argparse
from array import array
import warnings

from fhaosmo_ros.core import ConfigurationError, Observer
from fhaosmo_ros.core.parameters.declaration import KINDS, Parameter
from fhaosmo_ros.core.parameters.files import complete, load, select
from fhaosmo_ros.core.parameters.per_channel import of_channel, with_channels
from fhaosmo_ros.core.parameters.removed import REMOVED
from fhaosmo_ros.core.parameters.tables import (
    ESTIMATOR_PARAMETERS,
    NODE_TABLES,
    PLANT_NODE_PARAMETERS,
)
from fhaosmo_ros.tools.cli.options import add_parameter_options, channel_parameters
import numpy as np
import pytest

ALL = {**ESTIMATOR_PARAMETERS, **PLANT_NODE_PARAMETERS}


def test_declaration_is_complete():
    for name, parameter in ALL.items():
        assert parameter.kind in KINDS, name
        assert parameter.text.endswith('.'), name
        assert name.isidentifier()
        assert name == name.lower()
        assert bool(parameter.lengths) == parameter.kind.endswith('array'), name
        got = parameter.coerce(parameter.default)
        assert (got, type(got)) == (parameter.default, type(parameter.default)), name
        if parameter.kind in ('int', 'double', 'double_array'):
            assert parameter.lower < parameter.upper, name
    ESTIMATOR_PARAMETERS.defaults()['phi'].append('0')  # a fresh copy
    assert len(ESTIMATOR_PARAMETERS['phi'].default) == ESTIMATOR_PARAMETERS['order'].default


LIMITS = {'unit': 'm', 'lower': 0.0, 'upper': 2.0, 'lower_open': True}
DECLARED = {
    'bool': Parameter('p', True, 'A switch.'),
    'int': Parameter('p', 2, 'A count.', lower=1, upper=9),
    'double': Parameter('p', 0.5, 'A length.', **LIMITS),
    'string': Parameter('p', 'sign', 'A choice.', choices=('sign', 'fuzzy')),
    'double_array': Parameter('p', [0.5], 'Lengths.', **LIMITS),
    'string_array': Parameter('p', ['0'], 'Expressions.'),
}


@pytest.mark.parametrize(('kind', 'expected', 'values'), [
    ('bool', False, [False, np.bool_(False)]),
    ('int', 9, [9, np.int64(9)]),
    ('double', 2.0, [2, 2.0, np.float64(2.0)]),
    ('double_array', [2.0], [2, '2', [2], (2.0,), '[2]', np.array([2]), array('d', [2])]),
    # As in C and rcl, unlike YAML 1.1.
    ('double_array', [0.5, 1.0], [[0.5, 1], '[0.5, 1]', '[5e-1, .1E1]', '[5.e-1, +1e0]']),
    ('string_array', ['0', '0.5', '-z3'], [[0, 0.5, '-z3'], '[0, 0.5, -z3]', ('0', '0.5', '-z3')]),
])  # fmt: skip
def test_what_is_meant_is_taken_in_the_declared_type(kind, expected, values):
    for value in values:
        got = DECLARED[kind].coerce(value)
        assert (got, type(got)) == (expected, type(expected))
        assert kind != 'double_array' or all(isinstance(item, float) for item in got)


@pytest.mark.parametrize(('kind', 'allowed', 'values'), [
    ('bool', 'true or false', [0, 1, 'true', 1.0]),
    ('int', 'an integer >= 1 and <= 9', [0, 10, 1.0, '1', True, [1]]),
    ('double', 'a number > 0 and <= 2 [m]',
     [0, 2.1, float('nan'), float('inf'), True, '1', [1.0], 10**400]),
    ('string', 'one of sign, fuzzy', ['fuzy', 'qqq', '', 1]),
    ('double_array', 'a list of numbers > 0 and <= 2 [m]',
     [[1.0, 0.0], [float('nan')], [True], ['1'], [[1.0]], [10**400],
      '[', '[1, 2', 'a: b', '[[1]]', '!!python/x', '[~]']),
    ('string_array', 'a list of strings', [['0', True], ['0', ['z1']], 5, '[0, true]']),
])  # fmt: skip
def test_all_else_is_refused_in_one_line(kind, allowed, values):
    for value in [*values, None, {}, {'a': 1}, object, [], b'0', 1j, [None]]:
        with pytest.raises(ConfigurationError) as error:
            DECLARED[kind].coerce(value)
        message = str(error.value)
        assert message.isprintable()
        assert len(message) < 600
        assert message.startswith(f"parameter 'p': expected {allowed}, got ")
        assert message.endswith("got 'fuzy'; did you mean 'fuzzy'?") == (value == 'fuzy')


def test_unknown_and_old_names_are_told():
    for table in NODE_TABLES.values():
        for name in table:
            with pytest.raises(ConfigurationError, match=f"unknown parameter '{name}x'.*{name}"):
                table.coerce({name + 'x': 1.0})
        assert not REMOVED.keys() & table.keys()
    for name, successor in REMOVED.items():
        for wrong, values in ((name, {}), (f'hip.{name}', {'channels': ['hip']})):
            with pytest.raises(ConfigurationError) as error:
                complete(values | {wrong: 1.0}, ESTIMATOR_PARAMETERS)
            assert str(error.value) == f"parameter '{wrong}' is gone: {successor}"


@pytest.mark.parametrize(('name', 'value', 'allowed'), [
    ('lambda', [1.0, 2.0], '1 or 4 values, got [1.0, 2.0]'),
    ('initial_internal', [0.0] * 3, '1 or 4 values'), ('fuzzy_widths', [1.0] * 5, '1 to 4 values'),
    ('phi', ['0', '0'], '3 expressions (order = 3), got 2'),
])  # fmt: skip
def test_list_of_the_wrong_length_is_refused(name, value, allowed):
    with pytest.raises(ConfigurationError) as error:
        Observer({name: value})
    assert f"'{name}': expected {allowed}" in str(error.value)


@pytest.mark.parametrize(('values', 'reason'), [
    ({'unknown_input': False, 'unknown_input_derivatives': 1}, 'expected unknown_input = true'),
    ({'scheme': 'predict_correct'}, "scheme = 'explicit' or 'implicit' with cascade"),
    ({'structure': 'levant', 'unknown_input': False}, 'unknown_input = true'),
    ({'structure': 'levant', 'scheme': 'explicit'}, "scheme = 'implicit' or 'predict"),
    ({'gains': 'self_tuning', 'unknown_input': False}, 'unknown_input'),
])  # fmt: skip
def test_values_that_do_not_fit_together_are_refused(values, reason):
    with pytest.raises(ConfigurationError, match=reason):
        Observer(values)


def test_default_gains_with_the_plant_of_a_user_are_warned_of():
    """Whether a value is given or is the default makes no difference."""
    model = {'order': 2, 'phi': ['0', '-z2']}
    with pytest.warns(UserWarning, match='gains to self_tuning'):
        Observer(model)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for fine in ({}, {'phi': ['0', '0', '-z3']}, model | {'lambda': 3.0},
                     model | {'gains': 'self_tuning'}):  # fmt: skip
            Observer(fine)


# Of many channels: common values, and a channel's own in their place


NAMES = ['hip', 'knee_2']


@pytest.mark.parametrize(('values', 'reason'), [
    ({'channels': ['hip', 'hip']}, 'every name once'), ({'channels': []}, 'a list of strings'),
    *(({'channels': [*NAMES, name]}, 'names of letters')
      for name in ('', '2hip', 'hip/left', 'a__b', 'a.b')),
    ({'channels': ['lambda']}, r"names that no parameter has \(there is one 'lambda'\)"),
    *(({'channels': NAMES, name: 1.0}, f"unknown parameter '{name}'")
      for name in ('hpi.lambda', 'hip.lamda', 'hip.publish_rate')),
    ({'channels': NAMES, 'hip.epsilon': -1}, "parameter 'hip.epsilon': expected a number > 0"),
])  # fmt: skip
def test_bad_names_and_values_are_refused(values, reason):
    with pytest.raises(ConfigurationError, match=reason):
        select(values, ESTIMATOR_PARAMETERS)


def test_own_value_wins_and_the_common_one_serves_the_rest():
    values = {'channels': NAMES, 'epsilon': 5, 'hip.epsilon': 7, 'knee_2.lambda': 3}
    values = select(values, ESTIMATOR_PARAMETERS)
    hip, knee = (of_channel(values, name) for name in NAMES)
    assert (hip['epsilon'], knee['epsilon']) == (7.0, 5.0)
    assert (knee['lambda'], 'lambda' in hip) == ([3.0], False)
    table = with_channels(ESTIMATOR_PARAMETERS, NAMES, {'epsilon': 9.0})
    assert table['hip.order'].live == ESTIMATOR_PARAMETERS['order'].live
    assert table['hip.epsilon'].default == 9.0  # the common value
    assert table['hip.max_gap'].default == ESTIMATOR_PARAMETERS['max_gap'].default


def replayed(*words):
    parser = argparse.ArgumentParser()
    add_parameter_options(parser)
    return channel_parameters(parser.parse_args(words))


def test_one_file_serves_channels_and_plant_and_a_replay_takes_one_channel(tmp_path):
    rig = tmp_path / 'rig.yaml'
    rig.write_text(
        '/**:\n  ros__parameters:\n    channels: [hip, knee]\n    sample_rate: 50.0\n'
        '    epsilon: 5.0\n    hip:\n      epsilon: 7.0\n'
    )
    channels = {'channels': ['hip', 'knee'], 'epsilon': 5.0, 'hip.epsilon': 7.0}
    assert load(rig, 'estimator') == channels
    assert load(rig, 'plant') == {'sample_rate': 50.0}
    words = ['--params-file', str(rig), '-p', 'knee.lambda:=3']
    assert replayed(*words, '--channel', 'hip') == {'epsilon': 7.0}
    assert replayed(*words, '--channel', 'knee') == {'epsilon': 5.0, 'lambda': [3.0]}
    with pytest.raises(ConfigurationError, match='--channel: expected hip or knee, got none'):
        replayed(*words)
    with pytest.raises(ConfigurationError, match=r'--channel: expected none, .* got hip'):
        replayed('--channel', 'hip')
