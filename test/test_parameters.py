# SPDX-License-Identifier: Apache-2.0
"""Every declared parameter, by the rules that all of them share."""

from array import array
import warnings

from fhaosmo_ros.core import ConfigurationError, Observer
from fhaosmo_ros.core.parameters import files
from fhaosmo_ros.core.parameters.declaration import KINDS, Parameter, ParameterTable
from fhaosmo_ros.core.parameters.removed import REMOVED
from fhaosmo_ros.core.parameters.tables import (
    ESTIMATOR_PARAMETERS,
    NODE_TABLES,
    PLANT_NODE_PARAMETERS,
)
import numpy as np
import pytest

ALL = {**ESTIMATOR_PARAMETERS, **PLANT_NODE_PARAMETERS}
NUMBERS = [p for p in ALL.values() if p.kind in ('int', 'double', 'double_array')]
DOUBLES = [p for p in NUMBERS if p.kind != 'int']
LISTS = [p for p in ALL.values() if p.kind.endswith('array')]


def shaped(parameter, item):
    return [item] if parameter.kind.endswith('array') else item


def refused(parameter, value):
    """Check the message for a refused value and return it."""
    try:
        got = parameter.coerce(value)
    except ConfigurationError as error:
        message = str(error)
    else:
        pytest.fail(f'{parameter.name} takes {value!r} for {got!r}')
    assert message.isprintable()
    assert message.startswith(f"parameter '{parameter.name}': expected {parameter.allowed}, got ")
    assert len(message) < 600
    return message


def test_default_is_a_valid_value():
    for name, parameter in ALL.items():
        got = parameter.coerce(parameter.default)
        assert (got, type(got)) == (parameter.default, type(parameter.default)), name


def test_declaration_is_complete():
    for name, parameter in ALL.items():
        assert parameter.kind in KINDS, name
        assert parameter.text.endswith('.'), name
        assert parameter.name == name == name.lower()
        assert name.isidentifier()
        assert bool(parameter.lengths) == parameter.kind.endswith('array'), name
        if parameter.choices:
            default = parameter.default
            defaults = default if isinstance(default, list) else [default]
            assert set(defaults) <= set(parameter.choices), name
            assert all(choice in parameter.allowed for choice in parameter.choices), name


def test_number_has_bounds_and_says_so():
    for parameter in NUMBERS:
        assert parameter.lower < parameter.upper, parameter.name
        sign = '>' if parameter.lower_open else '>='
        bounds = f'{sign} {parameter.lower:g} and <= {parameter.upper:g}'
        assert bounds in parameter.allowed, parameter.name
        if parameter.unit:
            assert f'[{parameter.unit}]' in parameter.allowed, parameter.name


def test_bounds_hold():
    for parameter in NUMBERS:
        whole = int if parameter.kind == 'int' else float
        parameter.coerce(shaped(parameter, whole(parameter.upper)))
        low = shaped(parameter, whole(parameter.lower))
        if parameter.lower_open:
            refused(parameter, low)
        else:
            parameter.coerce(low)
        for beyond in (parameter.lower - 1, parameter.upper * 2 + 1):
            message = refused(parameter, shaped(parameter, whole(beyond)))
            assert repr(whole(beyond)) in message


def test_integer_is_accepted_where_a_number_is_meant():
    tried = 0
    for parameter in DOUBLES:
        candidates = [1, 0, int(parameter.upper)]
        for value in [v for v in candidates if parameter.lower < v <= parameter.upper][:1]:
            accepts_integer(parameter, value)
            tried += 1
    assert tried > len(DOUBLES) / 2


def accepts_integer(parameter, value):
    got = parameter.coerce(shaped(parameter, value))
    number = got[0] if isinstance(got, list) else got
    assert (type(number), number) == (float, value), parameter.name
    # A numpy scalar too, and what rclpy delivers for a list.
    assert parameter.coerce(shaped(parameter, np.float64(value))) == got
    if isinstance(got, list):
        assert parameter.coerce(array('d', [value])) == got
        assert parameter.coerce(np.array([value])) == got
        assert parameter.coerce((value,)) == got
        assert parameter.coerce(value) == got  # one number for every level
        assert parameter.coerce(f'[{value}]') == got  # from a command line
        assert parameter.coerce(f'[{value}, {value}.0]') == got * 2


@pytest.mark.parametrize(
    'item', [float('nan'), float('inf'), -float('inf'), True, None, '1', [1.0]]
)
def test_what_is_not_a_finite_number_is_refused(item):
    for parameter in DOUBLES:
        assert repr(item) in refused(parameter, shaped(parameter, item))


def test_integer_too_long_for_a_double_is_refused():
    for parameter in DOUBLES:
        refused(parameter, shaped(parameter, 10**400))


@pytest.mark.parametrize('value', [None, {}, {'a': 1}, object, [], '', b'0', 1j, [None]], ids=repr)
def test_value_of_another_kind_is_refused(value):
    for parameter in ALL.values():
        any_text = parameter.kind == 'string' and not parameter.choices
        if not (value == '' and any_text):
            refused(parameter, value)


@pytest.mark.parametrize('value', [0, 1, 'true', 'yes', 1.0])
def test_bool_is_true_or_false_only(value):
    for parameter in (p for p in ALL.values() if p.kind == 'bool'):
        refused(parameter, value)
        assert parameter.coerce(True) is True
        assert parameter.coerce(np.bool_(False)) is False


@pytest.mark.parametrize('value', [1.0, 1.5, '1', True, [1]])
def test_integer_is_an_integer_only(value):
    for parameter in (p for p in ALL.values() if p.kind == 'int'):
        refused(parameter, value)
        assert type(parameter.coerce(np.int64(2))) is int


def test_unknown_choice_gets_the_closest_one():
    for parameter in (p for p in ALL.values() if p.choices):
        choice = parameter.choices[-1]
        for wrong in (choice + 'x', choice[:-1]):
            assert f"did you mean '{choice}'?" in refused(parameter, wrong)
        assert 'did you mean' not in refused(parameter, 'qqqqqq')


@pytest.mark.parametrize('text', ['[', '[1, 2', 'a: b', '{1: 2}', '[[1]]', '!!python/x', '[~]'])
def test_text_that_is_no_list_is_refused(text):
    for parameter in LISTS:
        refused(parameter, text)


def test_numbers_in_a_list_of_expressions_become_text():
    phi = ALL['phi']
    assert phi.coerce([0, 0.5, '-z3']) == ['0', '0.5', '-z3']
    assert phi.coerce('[0, 0.5, -z3]') == ['0', '0.5', '-z3']
    assert phi.coerce(('0', 'u*z1')) == ['0', 'u*z1']
    for value in (['0', True], ['0', None], ['0', ['z1']], 5, '[0, true]'):
        refused(phi, value)


@pytest.mark.parametrize('number', ['1e-3', '1E3', '-2e+2', '.5e1', '1.e2'])
def test_exponent_without_a_point_is_a_number(number):
    # As in C and in rcl; YAML 1.1 itself would take it for text.
    parameter = Parameter('p', [0.0], 'A list.')
    assert parameter.coerce(f'[{number}, 1]') == [float(number), 1.0]


def test_unknown_names_get_the_closest_match():
    for table in NODE_TABLES.values():
        for name in table:
            wrong = name + 'x'
            with pytest.raises(ConfigurationError, match=f"unknown parameter '{wrong}'.*{name}"):
                table.coerce({wrong: 1.0})
        with pytest.raises(ConfigurationError) as error:
            table.coerce({'qqqq': 1})
        assert all(name in str(error.value) for name in table)


def test_defaults_are_fresh():
    first = ESTIMATOR_PARAMETERS.defaults()
    first['lambda'].append(1.0)
    first['phi'].append('0')
    assert ESTIMATOR_PARAMETERS.defaults() == {
        n: p.default for n, p in ESTIMATOR_PARAMETERS.items()
    }


def test_absent_stays_absent():
    table = ParameterTable([Parameter('a', 1.0, 'A.'), Parameter('b', 2.0, 'B.')])
    assert table.coerce({'b': 3}) == {'b': 3.0}
    assert table.coerce({}) == {}
    assert list(table) == ['a', 'b']


@pytest.mark.parametrize(
    ('name', 'value', 'allowed'),
    [
        ('lambda', [1.0, 2.0], '1 or 4 values'),
        ('alpha', [1.0] * 5, '1 or 4 values'),
        ('initial_estimate', [0.0] * 3, '1 or 4 values'),
        ('initial_internal', [0.0] * 2, '1 or 4 values'),
        ('fuzzy_widths', [1.0] * 5, '1 to 4 values'),
        ('phi', ['0', '0'], '3 expressions'),
    ],
)
def test_list_of_the_wrong_length_is_refused(name, value, allowed):
    for changes in ({name: value}, {name: str(value)}, {name: np.array(value)}):
        with pytest.raises(ConfigurationError) as error:
            Observer(changes)
        message = str(error.value)
        assert message.isprintable()
        for part in (f"'{name}'", allowed, repr(value) if name != 'phi' else 'got 2'):
            assert part in message


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


@pytest.mark.parametrize('name', REMOVED)
@pytest.mark.parametrize('prefix', ['', 'hip.'])
def test_parameter_of_an_older_version_names_its_successor(name, prefix):
    values = {'channels': ['hip']} if prefix else {}
    with pytest.raises(ConfigurationError) as error:
        files.complete(values | {prefix + name: 1.0}, ESTIMATOR_PARAMETERS)
    assert str(error.value) == f"parameter '{prefix}{name}' is gone: {REMOVED[name]}"
    assert not any(name in table for table in files.NODE_TABLES.values())
