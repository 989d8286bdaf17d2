# SPDX-License-Identifier: Apache-2.0
"""Every declared parameter, by the rules that all of them share; and those of many channels."""

import argparse
from array import array
import warnings

from fhaosmo_ros.core import ConfigurationError, Observer
from fhaosmo_ros.core.parameters import files
from fhaosmo_ros.core.parameters.declaration import KINDS, Parameter
from fhaosmo_ros.core.parameters.files import load, select
from fhaosmo_ros.core.parameters.per_channel import channel_names, of_channel, with_channels
from fhaosmo_ros.core.parameters.removed import REMOVED
from fhaosmo_ros.core.parameters.tables import (
    CHANNEL_PARAMETERS,
    ESTIMATOR_PARAMETERS,
    NODE_TABLES,
    PLANT_NODE_PARAMETERS,
)
from fhaosmo_ros.tools.cli.options import add_parameter_options, channel_parameters
import numpy as np
import pytest

ALL = {**ESTIMATOR_PARAMETERS, **PLANT_NODE_PARAMETERS}
NUMBERS = [p for p in ALL.values() if p.kind in ('int', 'double', 'double_array')]
DOUBLES = [p for p in NUMBERS if p.kind != 'int']


def shaped(parameter, item):
    return [item] if parameter.kind.endswith('array') else item


def refused(parameter, value):
    """Check the message for a refused value and return it."""
    with pytest.raises(ConfigurationError) as error:
        parameter.coerce(value)
    message = str(error.value)
    assert message.isprintable()
    assert message.startswith(f"parameter '{parameter.name}': expected {parameter.allowed}, got ")
    assert len(message) < 600
    return message


def test_declaration_is_complete():
    for name, parameter in ALL.items():
        assert parameter.kind in KINDS, name
        assert parameter.text.endswith('.'), name
        assert parameter.name == name == name.lower()
        assert name.isidentifier()
        assert bool(parameter.lengths) == parameter.kind.endswith('array'), name
        got = parameter.coerce(parameter.default)
        assert (got, type(got)) == (parameter.default, type(parameter.default)), name
    ESTIMATOR_PARAMETERS.defaults()['phi'].append('0')  # a fresh copy
    assert len(ESTIMATOR_PARAMETERS['phi'].default) == ESTIMATOR_PARAMETERS['order'].default


def test_bounds_hold_and_are_told():
    for parameter in NUMBERS:
        whole = int if parameter.kind == 'int' else float
        sign = '>' if parameter.lower_open else '>='
        assert parameter.lower < parameter.upper, parameter.name
        assert f'{sign} {parameter.lower:g} and <= {parameter.upper:g}' in parameter.allowed
        assert not parameter.unit or f'[{parameter.unit}]' in parameter.allowed
        parameter.coerce(shaped(parameter, whole(parameter.upper)))
        low = shaped(parameter, whole(parameter.lower))
        if parameter.lower_open:
            refused(parameter, low)
        else:
            parameter.coerce(low)
        for beyond in (parameter.lower - 1, parameter.upper * 2 + 1):
            assert repr(whole(beyond)) in refused(parameter, shaped(parameter, whole(beyond)))


def test_any_number_is_accepted_where_one_is_meant():
    tried = 0
    for parameter in DOUBLES:
        candidates = [1, 0, int(parameter.upper)]
        for value in [v for v in candidates if parameter.lower < v <= parameter.upper][:1]:
            tried += 1
            given = [shaped(parameter, value), shaped(parameter, np.float64(value))]
            wanted = shaped(parameter, float(value))
            if parameter.kind == 'double_array':
                given += [array('d', [value]), np.array([value]), (value,), value]
                given += [f'[{value}]']  # as rclpy and a command line deliver it
                assert parameter.coerce(f'[{value}, {value}.0]') == wanted * 2
            for one in given:
                got = parameter.coerce(one)
                assert (got, type(got)) == (wanted, type(wanted)), parameter.name
                assert isinstance(got[0] if isinstance(got, list) else got, float)
    assert tried > len(DOUBLES) / 2


def test_value_of_another_kind_is_refused():
    nothing = [None, {}, {'a': 1}, object, [], '', b'0', 1j, [None]]
    kinds = {'bool': (0, 1, 'true', 'yes', 1.0), 'int': (1.0, 1.5, '1', True, [1])}
    for parameter in ALL.values():
        for value in (*nothing, *kinds.get(parameter.kind, ())):
            if not (value == '' and parameter.kind == 'string' and not parameter.choices):
                refused(parameter, value)
        if parameter.kind == 'bool':
            assert parameter.coerce(np.bool_(False)) is False
        elif parameter.kind == 'int':
            assert type(parameter.coerce(np.int64(2))) is int
        elif parameter.kind.endswith('array'):
            for text in ('[', '[1, 2', 'a: b', '{1: 2}', '[[1]]', '!!python/x', '[~]'):
                refused(parameter, text)
    for parameter in DOUBLES:
        for item in (float('nan'), float('inf'), -float('inf'), True, None, '1', [1.0]):
            assert repr(item) in refused(parameter, shaped(parameter, item))
        refused(parameter, shaped(parameter, 10**400))


def test_unknown_choice_gets_the_closest_one():
    for parameter in (p for p in ALL.values() if p.choices):
        choice = parameter.choices[-1]
        for wrong in (choice + 'x', choice[:-1]):
            assert f"did you mean '{choice}'?" in refused(parameter, wrong)
        assert 'did you mean' not in refused(parameter, 'qqqqqq')


def test_numbers_in_a_list_of_expressions_become_text():
    phi = ALL['phi']
    assert phi.coerce([0, 0.5, '-z3']) == phi.coerce('[0, 0.5, -z3]') == ['0', '0.5', '-z3']
    assert phi.coerce(('0', 'u*z1')) == ['0', 'u*z1']
    for value in (['0', True], ['0', None], ['0', ['z1']], 5, '[0, true]'):
        refused(phi, value)
    for number in ('1e-3', '1E3', '-2e+2', '.5e1', '1.e2'):  # as in C and rcl, unlike YAML 1.1
        assert Parameter('p', [0.0], 'A list.').coerce(f'[{number}, 1]') == [float(number), 1.0]


def test_unknown_and_old_names_are_told():
    for table in NODE_TABLES.values():
        for name in table:
            wrong = name + 'x'
            with pytest.raises(ConfigurationError, match=f"unknown parameter '{wrong}'.*{name}"):
                table.coerce({wrong: 1.0})
        with pytest.raises(ConfigurationError) as error:
            table.coerce({'qqqq': 1})
        assert all(name in str(error.value) for name in table)
        assert not REMOVED.keys() & table.keys()
    for name, successor in REMOVED.items():
        for wrong, values in ((name, {}), (f'hip.{name}', {'channels': ['hip']})):
            with pytest.raises(ConfigurationError) as error:
                files.complete(values | {wrong: 1.0}, ESTIMATOR_PARAMETERS)
            assert str(error.value) == f"parameter '{wrong}' is gone: {successor}"


@pytest.mark.parametrize(('name', 'value', 'allowed'), [
    ('lambda', [1.0, 2.0], '1 or 4 values'), ('initial_estimate', [0.0] * 3, '1 or 4 values'),
    ('initial_internal', [0.0] * 2, '1 or 4 values'), ('fuzzy_widths', [1.0] * 5, '1 to 4 values'),
    ('phi', ['0', '0'], '3 expressions'),
])  # fmt: skip
def test_list_of_the_wrong_length_is_refused(name, value, allowed):
    for changes in ({name: value}, {name: str(value)}, {name: np.array(value)}):
        with pytest.raises(ConfigurationError) as error:
            Observer(changes)
        message = str(error.value)
        assert message.isprintable()
        for part in (f"'{name}'", allowed, repr(value) if name != 'phi' else 'got 2'):
            assert part in message


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


@pytest.mark.parametrize(('names', 'reason'), [
    (['hip', 'hip'], 'every name once'), ([], 'a list of strings'),
    *(([*names], 'names of letters') for names in (
        ('hip', ''), ('2hip',), ('hip/left',), ('a__b',), ('hip.left',),
    )),
    (['lambda'], "names that no parameter has (there is one 'lambda')"),
])  # fmt: skip
def test_bad_names_are_refused(names, reason):
    with pytest.raises(ConfigurationError, match="parameter 'channels': expected ") as error:
        channel_names({'channels': names})
    assert reason in str(error.value)


def test_own_value_wins_and_the_common_one_serves_the_rest():
    values = {'channels': NAMES, 'epsilon': 5, 'hip.epsilon': 7, 'knee_2.lambda': 3}
    values = select(values, ESTIMATOR_PARAMETERS)
    hip, knee = (of_channel(values, name) for name in NAMES)
    assert (hip['epsilon'], knee['epsilon']) == (7.0, 5.0)
    assert (knee['lambda'], 'lambda' in hip) == ([3.0], False)


def test_own_parameters_are_declared_and_checked_as_the_common_ones():
    assert list(with_channels(ESTIMATOR_PARAMETERS, channel_names({}))) == [*ESTIMATOR_PARAMETERS]
    table = with_channels(ESTIMATOR_PARAMETERS, NAMES, {'epsilon': 9.0})
    assert len(table) == len(ESTIMATOR_PARAMETERS) + 2 * len(CHANNEL_PARAMETERS)
    with pytest.raises(ConfigurationError, match=r"'hip.epsilon': expected a number > 0 .*got -1"):
        table.coerce({'hip.epsilon': -1})
    assert table['hip.order'].live == ESTIMATOR_PARAMETERS['order'].live
    assert table['hip.epsilon'].default == 9.0  # the common value
    assert table['hip.max_gap'].default == ESTIMATOR_PARAMETERS['max_gap'].default


@pytest.mark.parametrize('name', ['hpi.lambda', 'hip.lamda', 'hip.publish_rate'])
def test_unknown_names_are_told(name):
    with pytest.raises(ConfigurationError, match=f"unknown parameter '{name}'"):
        select({'channels': NAMES, name: 1.0}, ESTIMATOR_PARAMETERS)


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
    assert load(rig, 'plant', PLANT_NODE_PARAMETERS) == {'sample_rate': 50.0}
    words = ['--params-file', str(rig), '-p', 'knee.lambda:=3']
    assert replayed(*words, '--channel', 'hip') == {'epsilon': 7.0}
    assert replayed(*words, '--channel', 'knee') == {'epsilon': 5.0, 'lambda': [3.0]}
    with pytest.raises(ConfigurationError, match='--channel: expected hip or knee, got none'):
        replayed(*words)
    with pytest.raises(ConfigurationError, match=r'--channel: expected none, .* got hip'):
        replayed('--channel', 'hip')
