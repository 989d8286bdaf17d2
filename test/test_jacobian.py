# SPDX-License-Identifier: Apache-2.0
"""Values and derivatives of random expressions, against sympy's of the same text."""

from fhaosmo_ros.core import TriangularModel
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import mpmath
import numpy as np
import pytest
import sympy

SYMBOLS = {name: sympy.Symbol(name, real=True) for name in ('z1', 'z2', 'z3', 'u')}


class signum(sympy.Function):  # sympy's own differs for complex arguments
    def fdiff(self, _=1):
        return sympy.Integer(0)


class magnitude(sympy.Function):
    def fdiff(self, _=1):
        return signum(self.args[0])


FUNCTIONS = {name: getattr(sympy, name) for name in ('sin', 'cos', 'tan', 'exp', 'log', 'sqrt')}
FUNCTIONS |= {'abs': magnitude, 'tanh': sympy.tanh, 'sign': signum}
FUNCTIONS_OF_TWO = {'atan2': sympy.atan2, 'min': sympy.Min, 'max': sympy.Max}
NUMERIC = [{'magnitude': abs, 'signum': mpmath.sign}, 'mpmath']
NUMERIC[0]['Heaviside'] = lambda x, _=0: (mpmath.sign(x) + 1) / 2

LEAVES = [*SYMBOLS] * 4 + ['1', '2', '0.5', '3.25', '1e-3', '10']
POWERS = ['2', '3', '-1', '0.5', '-2', '1.5', '0', '1', '(-z2)', 'u', '(0.3*z1)']
FORMS = ['({0} + {1})', '({0} - {1})', '({0} * {1})', '({0} / {1})', '(-{0})', '({0})**{2}']
FORMS += [f'{name}({{0}})' for name in FUNCTIONS]
FORMS += [f'{name}({{0}}, {{1}})' for name in FUNCTIONS_OF_TWO]
FORMS += ['log(abs({0}) + 0.1)', 'sqrt({0}*{0} + 0.1)', '(abs({0}) + 0.1)**{1}']  # in the domain


@st.composite
def expressions(draw, depth=4):
    if depth == 0 or not draw(st.integers(0, 3)):
        return draw(st.sampled_from(LEAVES))
    form = draw(st.sampled_from(FORMS))
    parts = [draw(expressions(depth - 1)) if f'{{{k}}}' in form else '' for k in (0, 1)]
    return form.format(*parts, draw(st.sampled_from(POWERS)) if '{2}' in form else '')


points = st.tuples(*[st.floats(0.1, 1.9).map(lambda x: round(x, 3))] * 4)


def exactly(expression, point):
    """Evaluate with 50 digits, so that whatever cancels in floating point shows."""
    function = sympy.lambdify([*SYMBOLS.values()], expression, NUMERIC)
    with mpmath.workdps(50):
        try:
            number = mpmath.mpmathify(function(*(mpmath.mpf(str(v)) for v in point)))
        except (ZeroDivisionError, OverflowError):
            return None
    return float(number) if isinstance(number, mpmath.mpf) and mpmath.isfinite(number) else None


def compare(text, point):
    """Compare with sympy; return False where there is nothing to compare."""
    names = {**SYMBOLS, **FUNCTIONS, **FUNCTIONS_OF_TWO}
    try:
        exact = sympy.nsimplify(sympy.parse_expr(text, names, evaluate=True), rational=True)
        wanted = exactly(exact, point)
        slopes = [exactly(sympy.diff(exact, SYMBOLS[f'z{j}']), point) for j in (1, 2, 3)]
    except (KeyError, TypeError, ValueError):  # sympy's, for log(0) or min of complex numbers
        return False
    if wanted is None or None in slopes:
        return False
    if text.count('min') + text.count('max') > 1 and len(set(point)) < len(point):
        return False  # sympy simplifies ties of several; each slope between theirs is one
    z, u = np.array(point[:3]), point[3]
    model = TriangularModel(['0', '0', text])
    got, jacobian = model.evaluate(z, u)[2], model.jacobian(z, u)[2]
    # How much rounding of the inputs alone can do: a few ulps times the function's own slope.
    nudged = [model.evaluate(z * (1.0 + k * 1e-12), u * (1.0 - k * 1e-12))[2] for k in (-1, 1)]
    spread = max(abs(got - x) for x in nudged)
    if not spread <= 1e-6 * (1.0 + abs(got)):
        return False
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9 + spread)
    scale = max(1.0, *(abs(s) for s in slopes))
    np.testing.assert_allclose(jacobian, slopes, rtol=1e-6, atol=1e-8 * scale)
    return True


@settings(max_examples=120)
@given(expressions(), points)
def test_random_expression(text, point):
    try:
        assume(compare(text, point))
    except ValueError as error:  # refused, because a constant part is not a number: 1/0
        assert 'is not a finite number' in str(error)  # noqa: PT017


@pytest.mark.parametrize('text', [
    'sin(z1*z2)', 'cos(z3 - u)', 'tan(z1/2)', 'exp(-z1**2)', 'log(z1 + z2)', 'sqrt(z1*z3)',
    'abs(z1 - z2)', 'tanh(3*z3)', 'sign(z1 - z2)*z3', 'z1**-2.5', 'z1**z2', '2**z1', '(-z1)**-2',
    '(z1*z2)**(z3 - u)', '(z1 - z2)**3', 'atan2(z2 - 2, z1 - u)', 'max(min(z1, 1.1), 0.3)*z2',
])  # fmt: skip
@pytest.mark.parametrize('point', [(0.7, 1.3, 0.4, 0.9), (1.6, 0.2, 1.1, 0.3)])
def test_fixed_expression(text, point):
    assert compare(text, point)


@pytest.mark.parametrize(('text', 'slope'), [
    ('abs(z1)', 0.0),  # the middle of its subdifferential
    ('sign(z1)', 0.0), ('z1**2', 0.0), ('z1**1', 1.0), ('z1**0', 0.0), ('z1**1.5', 0.0),
    ('z1*abs(z1)', 0.0), ('sin(z1)', 1.0), ('sqrt(1 + z1)', 0.5), ('sqrt(0*z1)', 0.0),
    ('max(z1, -z1)', 0.0), ('min(z1, 0)', 0.5), ('atan2(z1, 1)', 1.0), ('atan2(0*z1, 0)', 0.0),
])  # fmt: skip
def test_derivative_at_0_is_finite(text, slope):
    np.testing.assert_array_equal(TriangularModel([text]).jacobian(np.zeros(1)), [[slope]])


@pytest.mark.parametrize('text', [
    'log(z1)', 'sqrt(z1)', 'z1**0.5', '0/(z1 + 1)', 'min(log(z1), 1)', 'min(1, log(z1))',
    'max(log(z1), 1)', 'max(1, log(z1))', 'atan2(log(z1), 1)',
])  # fmt: skip
def test_what_is_outside_a_domain_is_not_hidden(text):
    assert np.isnan(TriangularModel([text]).evaluate(np.array([-1.0]))).all()
