# SPDX-License-Identifier: Apache-2.0
"""Expressions from outside: what is accepted, what is refused, and how that is said."""

import ast
import math

from fhaosmo_ros.core import ConfigurationError, Observer, OnlineEstimator, TriangularModel
from fhaosmo_ros.core.model.expressions import (
    FUNCTIONS,
    MAX_LENGTH,
    MAX_OPERATIONS,
    parse,
)
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from yaml_texts import ANY_TEXT

Z, U = np.array([0.7, -1.3, 2.1]), 0.4
NAMES = {'z1': Z[0], 'z2': Z[1], 'z3': Z[2], 'u': U} | {
    name: getattr(np, name) for name in FUNCTIONS
}
NAMES |= {'pi': math.pi, 'atan2': math.atan2, 'min': min, 'max': max}

ACCEPTED = [
    '0', '-0', '1', '1.5e-3', '.5', '5.', '1_000', '0x10', '-z3', '+z1', 'u', '--z1', ' z1 ',
    'z1 + z2 - z3*u', 'z1/z2/z3', 'z1 - z2 - z3', '-z1**2', '(-z1)**2', '2**3**0.5', 'z1**-2',
    '-0.5*z2 - sin(z1)', 'sin(cos(tan(z1)))', 'exp(-z1**2)', 'log(abs(z2))', 'sqrt(z1**2 + 1)',
    'tanh(u)*sign(z2)', '(z1 + z2)*(z1 - z2)', '(z1\n+ z2)', 'z1  # a comment', 'abs(-z1)',
    '1/(1 + exp(-z3))', '3.7*sin(2*u) - 0.1*z3*abs(z3)', '*'.join(['z1'] * 40),
    'pi', '2*pi*z1', 'atan2(z1, z2)', 'atan2(0*z1, -1)', 'min(z1, z2)', 'max(z1, 0)',
    'max(min(z2, 1), -1)', 'min(z1, z2, z3, u)', 'max(1, 2, z1)', 'atan2(sin(z1), cos(z2))',
]  # fmt: skip


@pytest.mark.parametrize('text', ACCEPTED)
def test_value_is_that_of_python_and_numpy(text):
    expected = eval(text.strip(), {'__builtins__': {}}, NAMES)  # noqa: S307  our own list
    got = TriangularModel(['0', '0', text]).evaluate(Z, U)
    np.testing.assert_allclose(got, [0.0, 0.0, expected], rtol=1e-14)


REFUSED = {
    # code
    'import': "__import__('os').system('true')",
    'attribute': 'z1.__class__',
    'long attribute chain': 'z1' + '.a' * 240,
    'builtin': 'eval(z1)',
    'lambda': 'lambda: 1',
    'list comprehension': '[z1 for z1 in (1, 2)]',
    'f-string': "f'{z1}'",
    'text': "'z1'",
    'walrus': '(z1 := 2)',
    'two statements': 'z1; z2',
    'subscript': 'z1[0]',
    'list': '[z1]',
    'condition': 'z1 if z2 else z3',
    'and': 'z1 and z2',
    'invert': '~z1',
    'modulo': 'z1 % z2',
    'shift': 'z1 << 2',
    'yield': '(yield z1)',
    'star': '*z1',
    # calls
    'two arguments': 'sin(z1, z2)',
    'keyword': 'sin(x=z1)',
    'keywords': 'sin(**z1)',
    'function as a value': 'sin',
    'call of a call': 'sin(z1)(z2)',
    'unknown function': 'sinh(z1)',
    # names
    'z0': 'z0',
    'z01': 'z01',
    'z without a number': 'z',
    'z4 of 3': 'z4',
    'unknown name': 'x',
    'pi of a number': 'pi(2)',
    'three arguments of two': 'atan2(z1, z2, z3)',
    'function of two as a value': 'max',
    'false': '-False',
    # numbers
    'complex': '1j',
    'infinity': 'inf',
    'overflow': '1e999',
    'long integer': '9' * 400,
    'huge power': '9**9**9**9',
    'division by zero': '1/0',
    'logarithm of 0': 'log(0)',
    # text
    'empty': '',
    'comment only': '# z1',
    'half': 'z1 +',
    'implicit product': '2 z1',
    'null byte': 'z1\0',
    'surrogate': 'z1\ud800',
    'full-width name': '\uff5a\uff11',  # Python reads these two as z1
    'mathematical letters': '\U0001d42c\U0001d422\U0001d427(z1)',
    'Arabic digit': 'z\u0663',
    'minus sign': '\u2212z1',
    # size
    'too long': '0' + '+0' * MAX_LENGTH,
    'very long': 'z1+' * 1_000_000 + 'z1',
    'deep parentheses': '(' * 240 + 'z1' + ')' * 240,
    'deep sum': '+'.join(['z1'] * 120),
    'deep brackets': '[' * 190 + ']' * 190,
    '50000 parentheses': '(' * 50_000 + 'z1' + ')' * 50_000,
    'much work': '+'.join(['(' + '-' * 20 + 'z1)'] * 15),
    'many functions': '+'.join(['tan(' * 16 + 'z1' + ')' * 16] * 6),
    # what Python warns of
    'number without a space': '1if z1 else 2',
    'escape': '"\\d"',
}


@pytest.mark.parametrize('text', REFUSED.values(), ids=REFUSED.keys())
def test_anything_else_is_refused_in_one_line(text, recwarn):
    with pytest.raises(ConfigurationError) as error:
        TriangularModel(['0', '0', text])
    message = str(error.value)
    assert message.startswith("parameter 'phi': Phi_3 = ")
    assert repr(text)[1:30].rstrip("'") in message  # what arrived
    assert 'allowed are z1..z3, u, numbers, + - * / ** and sin cos' in message
    assert message.isprintable()  # so it is one line
    assert len(message) < MAX_LENGTH * 4 + 400
    assert error.value.__suppress_context__ or error.value.__context__ is None
    assert not recwarn.list


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('z4 + z1', 'z4 comes after z3: the model would not be triangular'),
        ('snh(z1)', "unknown function 'snh'; did you mean"),
        ('tanhh(z1)', "did you mean 'tanh'?"),
        ('z1 + sin', 'sin needs one argument'),
        ('z1.real', "'z1.real' is not allowed"),
        ('True', 'True is not a number'),
        ('1e400', 'a number is too large'),
        ('z1/(1 - 1)*0 + 1/0', 'a constant part of it is not a finite number'),
        ('2 z1', 'this is not an arithmetic expression'),
        ('-' * (MAX_OPERATIONS + 1) + 'z1', f'101 operations, at most {MAX_OPERATIONS}'),
        ('+'.join(['tan(z1)'] * 51), f'101 operations, at most {MAX_OPERATIONS}'),
        ('+'.join(['(-z1-u-1)'] * 26), f'103 operations, at most {MAX_OPERATIONS}'),
        ('z1' * MAX_LENGTH, f'{2 * MAX_LENGTH} characters, at most {MAX_LENGTH}'),
    ],
)
def test_message_gives_the_reason(text, reason):
    with pytest.raises(ConfigurationError) as error:
        TriangularModel(['0', '0', text])
    assert reason in str(error.value)


def test_what_is_just_within_the_limits_is_accepted():
    parse('-' * MAX_OPERATIONS + 'z1', 1)
    parse('+'.join(['tan(z1)'] * 50), 1)
    parse('*'.join(['(-z1-u-1)'] * 25), 1)
    parse('z1' + ' ' * (MAX_LENGTH - 4) + '+1', 1)


@pytest.mark.parametrize(('level', 'later'), [(1, 2), (1, 3), (2, 3), (1, 12)])
def test_later_state_is_refused(level, later):
    phi = ['0', '0', '0']
    phi[level - 1] = f'z1 + z{later}'
    with pytest.raises(ConfigurationError, match=f'Phi_{level} .*z{later} comes after z{level}'):
        TriangularModel(phi)


@pytest.mark.parametrize(('phi', 'order'), [(['0'], 2), (['0', '0', '0'], 2), ([], 1)])
def test_wrong_number_of_expressions_is_refused(phi, order):
    with pytest.raises(ConfigurationError) as error:
        TriangularModel(phi, order)
    message = str(error.value)
    assert message.startswith(f"parameter 'phi': expected {order} expressions")
    assert f'got {len(phi)}' in message


@given(ANY_TEXT | st.text('z1u23+-*/().e sincoexplgqrtab', max_size=40))
def test_any_text_is_either_an_expression_or_an_error(text):
    try:
        tape = parse(text, 3)
    except ConfigurationError as refusal:
        message = str(refusal)
    else:
        message = ''
        allowed = (ast.Expression, ast.BinOp, ast.UnaryOp, ast.Constant, ast.Name, ast.Call)
        allowed += (ast.operator, ast.unaryop, ast.expr_context)
        assert all(isinstance(n, allowed) for n in ast.walk(ast.parse(text.strip(), mode='eval')))
        assert all(math.isfinite(i.operand) for i in tape)
    assert message.isprintable()


def test_known_input_is_noticed():
    assert TriangularModel(['0', 'sin(u)']).uses_input
    assert not TriangularModel(['0', 'sin(z1)']).uses_input
    assert not TriangularModel(['0']).uses_input


def test_outside_its_domain_a_function_gives_no_finite_number():
    model = TriangularModel(['log(z1)', 'sqrt(z1)', '1/(z1 + 1)', 'z1**0.5'])
    with np.errstate(all='ignore'):
        assert not np.any(np.isfinite(model.evaluate(np.array([-1.0, 0.0, 0.0, 0.0]))))


MOTOR = {'order': 2, 'phi': ['0', '(k*torque - b*z2 - m*9.81*sin(z1) + load)/m']}
MOTOR |= {'inputs': ['torque', 'load'], 'constants.m': 2.0, 'constants.b': 0.5, 'constants.k': 3}


def test_named_inputs_and_constants_stand_for_their_values():
    model = TriangularModel.of(OBSERVER_PARAMETERS.complete(MOTOR))
    assert model.inputs == model.used_inputs == ('torque', 'load')
    z, (torque, load) = np.array([0.3, -0.7]), (1.5, -0.2)
    expected = (3 * torque - 0.5 * z[1] - 2 * 9.81 * np.sin(z[0]) + load) / 2
    np.testing.assert_allclose(model.evaluate(z, [torque, load]), [0.0, expected], rtol=1e-15)
    np.testing.assert_allclose(model.jacobian(z, [torque, load])[1], [-9.81 * np.cos(0.3), -0.25])


def test_named_model_is_the_same_as_one_with_numbers():
    numbers = {'order': 2, 'phi': ['0', '(3.0*u - 0.5*z2 - 2.0*9.81*sin(z1) + v)/2.0']}
    numbers |= {'inputs': ['u', 'v'], 'gains': 'fixed'}
    names, numbers = Observer(MOTOR | {'gains': 'fixed'}), Observer(numbers)
    rng = np.random.default_rng(1)
    t, y, u = np.arange(300) * 1e-3, rng.standard_normal(300), rng.standard_normal((300, 2))
    for mine, other in zip(names.run(t, y, u), numbers.run(t, y, u), strict=True):
        np.testing.assert_array_equal(mine, other)


def test_constant_changes_live_and_the_rest_stays():
    observer, other = Observer(MOTOR), Observer(MOTOR | {'constants.b': 0.9})
    observer.configure({'constants.b': 0.9})
    rng = np.random.default_rng(2)
    t, y, u = np.arange(100) * 1e-3, rng.standard_normal(100), rng.standard_normal((100, 2))
    for mine, wanted in zip(observer.run(t, y, u), other.run(t, y, u), strict=True):
        np.testing.assert_array_equal(mine, wanted)
    for bad in ({'constants.m': np.nan}, {'constants.q': 1.0}, {'constants.b': 'x'}):
        with pytest.raises(ConfigurationError, match=next(iter(bad)).rpartition('.')[2]):
            observer.configure(bad)
    assert observer.parameters['constants.m'] == 2.0


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'phi': ['0', 'z1^2'], 'inputs': ['u']}, r'z1\*\*2'),
        ({'phi': ['0', 'torqe']}, "did you mean 'torque'"),
        ({'phi': ['0', 'g']}, "'constants.g'"),
        ({'inputs': ['torque', 'torque']}, 'once'),
        ({'inputs': ['z1', 'torque', 'load']}, 'taken'),
        ({'inputs': ['pi', 'torque', 'load']}, 'taken'),
        ({'inputs': ['lambda', 'torque', 'load']}, 'letter'),
        ({'inputs': ['a b', 'torque', 'load']}, 'letter'),
        ({'constants.torque': 1.0}, 'once'),
        ({'constants.max': 1.0}, 'taken'),
        ({'constants.': 1.0}, 'unknown parameter'),
        ({'constants.a.b': 1.0}, 'unknown parameter'),
        ({'constants.m': np.inf}, 'constants.m'),
    ],
)
def test_bad_names_are_refused_in_words_that_help(changes, said):
    with pytest.raises(ConfigurationError, match=said):
        Observer(MOTOR | changes)


@pytest.mark.parametrize('u', [1.0, np.zeros(3), np.zeros(5), np.zeros((5, 3)), np.zeros((4, 2))])
def test_inputs_of_another_shape_are_refused(u):
    with pytest.raises(ConfigurationError, match='inputs torque, load'):
        Observer(MOTOR).run(np.arange(5) * 1e-3, np.zeros(5), u)
    with pytest.raises(ConfigurationError, match='inputs torque, load'):
        OnlineEstimator(MOTOR).run(np.arange(5) * 10**6, np.zeros(5), u)
