# SPDX-License-Identifier: Apache-2.0
"""Expressions from outside: what is accepted, what is refused, and how that is said."""

import ast
import math

from fhaosmo_ros.core import ConfigurationError, Observer, OnlineEstimator, TriangularModel
from fhaosmo_ros.core.model.triangular import MAX_LENGTH, MAX_OPERATIONS, parse
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from yaml_texts import ANY_TEXT

# How it is written; values of all functions are compared with sympy's in test_jacobian.py.
ACCEPTED = [
    '0', '-0', '1.5e-3', '.5', '5.', '1_000', '0x10', '-z3', '+z1', 'u', '--z1', ' z1 ',
    'z1/z2/z3', '-z1**2', '2**3**0.5', 'z1**-2', '(z1\n+ z2)', 'z1  # a comment',
    '*'.join(['z1'] * 40), '2*pi*z1', 'min(z1, z2, z3, u)', 'max(1, 2, z1)',
    '-' * MAX_OPERATIONS + 'z1', 'z1' + ' ' * (MAX_LENGTH - 4) + '+1',  # the limits
]  # fmt: skip


@pytest.mark.parametrize('text', ACCEPTED)
def test_value_is_that_of_python(text):
    z, u = np.array([0.7, -1.3, 2.1]), 0.4
    names = {'z1': z[0], 'z2': z[1], 'z3': z[2], 'u': u, 'pi': math.pi, 'min': min, 'max': max}
    expected = eval(text.strip(), {'__builtins__': {}}, names)  # noqa: S307  our own list
    got = TriangularModel(['0', '0', text]).evaluate(z, u)
    np.testing.assert_allclose(got, [0.0, 0.0, expected], rtol=1e-14)


REFUSED = [
    # code
    "__import__('os').system('true')", 'z1' + '.a' * 240, 'eval(z1)', 'lambda: 1', "f'{z1}'",
    '[z1 for z1 in (1, 2)]', "'z1'", '(z1 := 2)', 'z1; z2', 'z1[0]', 'z1 if z2 else z3',
    'z1 and z2', '~z1', 'z1 % z2', '(yield z1)', '*z1',
    # calls and names
    'sin(z1, z2)', 'sin(x=z1)', 'sin(**z1)', 'sin', 'sin(z1)(z2)', 'z0', 'z01', 'pi(2)', '-False',
    # numbers
    '1j', 'inf', '1e999', '9' * 400, '9**9**9**9', '1/0', 'log(0)',
    # text; Python reads full-width letters as z1, and warns of the last two
    '', '# z1', 'z1 +', 'z1\0', 'z1\ud800', '\uff5a\uff11', 'z\u0663', '1if z1 else 2', '"\\d"',
    # size
    '0' + '+0' * MAX_LENGTH, 'z1+' * 1_000_000 + 'z1', '(' * 240 + 'z1' + ')' * 240,
    '+'.join(['z1'] * 120), '[' * 190 + ']' * 190, '(' * 50_000 + 'z1' + ')' * 50_000,
    '+'.join(['(' + '-' * 20 + 'z1)'] * 15), '+'.join(['tan(' * 16 + 'z1' + ')' * 16] * 6),
]  # fmt: skip


REASONS = {
    'z4 + z1': 'z4 comes after z3: the model would not be triangular',
    'snh(z1)': "unknown function 'snh'; did you mean", 'z1^2': 'a power is written z1**2',
    'z1 + sin': 'sin needs one argument', 'z1.real': "'z1.real' is not allowed",
    'True': 'True is not a number', '1e400': 'a number is too large',
    'z1/(1 - 1)*0 + 1/0': 'a constant part of it is not a finite number',
    '2 z1': 'this is not an arithmetic expression',
    '-' * (MAX_OPERATIONS + 1) + 'z1': f'101 operations, at most {MAX_OPERATIONS}',
    'z1' * MAX_LENGTH: f'{2 * MAX_LENGTH} characters, at most {MAX_LENGTH}',
}  # fmt: skip


@pytest.mark.parametrize('text', [*REFUSED, *REASONS], ids=lambda text: ascii(text[:30]))
def test_anything_else_is_refused_in_one_line(text, recwarn):
    with pytest.raises(ConfigurationError) as error:
        TriangularModel(['0', '0', text])
    message = str(error.value)
    assert message.startswith("parameter 'phi': Phi_3 = ")
    assert REASONS.get(text, '') in message
    assert repr(text)[1:30].rstrip("'") in message  # what arrived
    assert 'allowed are z1..z3, u, numbers, + - * / ** and sin cos' in message
    assert message.isprintable()  # so it is one line
    assert len(message) < MAX_LENGTH * 4 + 400
    assert error.value.__suppress_context__ or error.value.__context__ is None
    assert not recwarn.list


@given(ANY_TEXT | st.text('z1u23+-*/().e sincoexplgqrtab', max_size=40))
def test_any_text_is_either_an_expression_or_an_error(text):
    try:
        tape, _ = parse(text, 3)
    except ConfigurationError as refusal:
        assert str(refusal).isprintable()  # noqa: PT017
        return
    allowed = (ast.Expression, ast.BinOp, ast.UnaryOp, ast.Constant, ast.Name, ast.Call)
    allowed += (ast.operator, ast.unaryop, ast.expr_context)
    assert all(isinstance(n, allowed) for n in ast.walk(ast.parse(text.strip(), mode='eval')))
    assert all(math.isfinite(x) for _, x in tape)


MOTOR = {'order': 2, 'phi': ['0', '(k*torque - b*z2 - m*9.81*sin(z1) + load)/m']}
MOTOR |= {'inputs': ['torque', 'load'], 'constants.m': 2.0, 'constants.b': 0.5, 'constants.k': 3}


def test_named_inputs_and_constants_stand_for_their_values():
    assert not TriangularModel(['0', 'sin(z1)']).used_inputs
    model = TriangularModel.of(OBSERVER_PARAMETERS.complete(MOTOR))
    assert model.inputs == model.used_inputs == ('torque', 'load')
    z, (torque, load) = np.array([0.3, -0.7]), (1.5, -0.2)
    expected = (3 * torque - 0.5 * z[1] - 2 * 9.81 * np.sin(z[0]) + load) / 2
    np.testing.assert_allclose(model.evaluate(z, [torque, load]), [0.0, expected], rtol=1e-15)
    np.testing.assert_allclose(model.jacobian(z, [torque, load])[1], [-9.81 * np.cos(0.3), -0.25])


@pytest.mark.parametrize(('changes', 'said'), [
    ({'phi': ['0', 'torqe']}, "did you mean 'torque'"), ({'phi': ['0', 'g']}, "'constants.g'"),
    *(({'inputs': [name, 'torque', 'load']}, said) for name, said in (
        ('torque', 'once'), ('z1', 'taken'), ('pi', 'taken'), ('lambda', 'letter'),
        ('a b', 'letter'),
    )),
    ({'constants.torque': 1.0}, 'once'), ({'constants.': 1.0}, 'unknown parameter'),
    ({'constants.a.b': 1.0}, 'unknown parameter'), ({'constants.m': np.inf}, 'constants.m'),
])  # fmt: skip
def test_bad_names_are_refused_in_words_that_help(changes, said):
    with pytest.raises(ConfigurationError, match=said):
        Observer(MOTOR | changes)


@pytest.mark.parametrize('u', [1.0, np.zeros(3), np.zeros(5), np.zeros((5, 3)), np.zeros((4, 2))])
def test_inputs_of_another_shape_are_refused(u):
    for kind, t in (Observer, np.arange(5) * 1e-3), (OnlineEstimator, np.arange(5) * 10**6):
        with pytest.raises(ConfigurationError, match='inputs torque, load'):
            kind(MOTOR).run(t, np.zeros(5), u)
