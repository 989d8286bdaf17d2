# SPDX-License-Identifier: Apache-2.0
"""The curves psi against scikit-fuzzy's own control system, and what they promise."""

from fhaosmo_ros.core import ConfigurationError
from fhaosmo_ros.core.observer.arrays import INVERSE_WIDTH
from fhaosmo_ros.core.observer.arrays import psi as read_psi
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.fuzzy import curve, infer, KNOTS, TERMS, terms_of_level
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import skfuzzy
from skfuzzy import control

# scikit-fuzzy 0.5.0 with numpy 2.4
pytestmark = pytest.mark.filterwarnings('ignore:Passing more than 2 positional')

SYSTEMS = [(terms, shape) for terms in TERMS for shape in ('triangle', 'gaussian')]
systems = pytest.mark.parametrize(('terms', 'shape'), SYSTEMS)
normalised = pytest.mark.parametrize('normalise', [True, False])


def law(level_widths=(0.02,), **options):
    p = {'variant': 'fuzzy', 'fuzzy_widths': list(level_widths)}
    return ObserverConfiguration(p | options).law


def psi(law, level, x):
    """Return psi of a signed x, as the compiled functions read it."""
    value, _ = read_psi(law, level, abs(x))
    return np.copysign(value, x)


def oracle(terms, shape):
    """Return the seed's rule base as a control system of scikit-fuzzy."""
    # The grid interpolates an input's memberships and holds the output's; its spacing must fit
    # the peaks of the terms, which lie at multiples of 1/2 and 1/3.
    universe = np.linspace(-1.0, 1.0, 12001)
    eps, out = control.Antecedent(universe, 'eps'), control.Consequent(universe, 'psi')
    out.defuzzify_method = 'centroid'
    gap = 2.0 / (terms - 1)
    for k, name in enumerate(TERMS[terms]):
        peak = -1.0 + k * gap
        if shape == 'triangle':
            mf = skfuzzy.trimf(universe, [peak - gap, peak, peak + gap])
        else:  # neighbours cross at 1/2
            mf = skfuzzy.gaussmf(universe, peak, 0.5 * gap / np.sqrt(2.0 * np.log(2.0)))
        eps[name], out[name] = mf, mf
    rules = [control.Rule(eps[name], out[name], label=name) for name in TERMS[terms]]
    return control.ControlSystemSimulation(control.ControlSystem(rules))


# The ends of the universe, knots, points between knots, the terms' peaks and crossings.
INPUTS = [0.0, 1 / 512, 0.1, 0.125, 0.2503, 1 / 3, 0.4, 0.5, 0.5001, 2 / 3, 0.77, 0.875, 0.99, 1.0]


@systems
def test_curve_agrees_with_a_control_system_of_scikit_fuzzy(terms, shape):
    level = 0 if terms == 5 else 1
    curves = law((1.0,), fuzzy_shape=shape, fuzzy_normalise=False)
    simulation = oracle(terms, shape)
    # Knots are h = 1/192 apart, and every corner of a triangle's curve is one. A smooth curve
    # leaves the straight line between two of them by h^2 / 8 times its curvature, some 10, hence
    # 4e-5; triangles are steeper beside their peaks.
    for x in INPUTS:
        for sign in (1.0, -1.0):
            simulation.input['eps'] = sign * x
            simulation.compute()
            np.testing.assert_allclose(
                psi(curves, level, sign * x), simulation.output['psi'], atol=1e-4
            )


@systems
def test_inference_agrees_with_a_control_system_of_scikit_fuzzy(terms, shape):
    simulation = oracle(terms, shape)
    for x in INPUTS:
        simulation.input['eps'] = x
        simulation.compute()
        # Nothing is interpolated between knots here; only the output grids differ.
        np.testing.assert_allclose(infer(x, terms, shape), simulation.output['psi'], atol=2e-6)


@systems
def test_inference_is_odd(terms, shape):
    for x in INPUTS:
        # The curve keeps the half for x >= 0 only; this is what makes that right.
        np.testing.assert_allclose(infer(-x, terms, shape), -infer(x, terms, shape), atol=1e-14)


@systems
@normalised
def test_curve_rises_from_0_to_its_end(terms, shape, normalise):
    values = curve(terms, shape, normalise)
    assert values.shape == (KNOTS,)
    assert values[0] == 0.0
    assert np.all(np.diff(values) > 0.0)
    assert values[-1] <= 1.0
    assert not values.flags.writeable
    if normalise:
        assert values[-1] == 1.0


@pytest.mark.parametrize(('terms', 'end'), [(5, 5.0 / 6.0), (7, 8.0 / 9.0)])
def test_centroid_alone_falls_short_of_1(terms, end):
    # The centroid of the outermost half triangle, a third of its base away from 1.
    np.testing.assert_allclose(curve(terms, 'triangle', False)[-1], end, atol=1e-6)


@systems
def test_normalised_curve_is_the_raw_one_scaled(terms, shape):
    raw = curve(terms, shape, False)
    np.testing.assert_allclose(curve(terms, shape, True), raw / raw[-1], rtol=1e-15)


def test_level_1_has_5_terms_and_the_others_7():
    assert [terms_of_level(level) for level in (1, 2, 3, 4, 12)] == [5, 7, 7, 7, 7]
    curves = law().curves
    np.testing.assert_array_equal(curves[0], curve(5, 'triangle', True))
    for row in curves[1:]:
        np.testing.assert_array_equal(row, curve(7, 'triangle', True))


def test_last_width_serves_the_levels_that_follow():
    inverse = law((0.1, 0.4)).gains[INVERSE_WIDTH]
    np.testing.assert_array_equal(inverse, [10.0, 2.5, 2.5, 2.5])


def test_unknown_shape_is_refused():
    with pytest.raises(ConfigurationError, match='fuzzy_shape'):
        infer(0.0, 5, 'bell')


LAWS = {
    (shape, normalise): law((0.02, 0.5), fuzzy_shape=shape, fuzzy_normalise=normalise)
    for shape in ('triangle', 'gaussian')
    for normalise in (True, False)
}
any_law = st.sampled_from(list(LAWS.values()))
levels = st.integers(0, 3)
inputs = st.floats(0.0, 1.0) | st.floats(0.0, 1e300)


@given(any_law, levels, inputs, inputs)
def test_psi_is_bounded_and_monotone(law, level, a, b):
    low, high = sorted([a, b])
    assert 0.0 <= psi(law, level, low) <= psi(law, level, high) <= 1.0


@given(any_law, levels, inputs, inputs)
def test_psi_is_continuous(law, level, a, b):
    # Lipschitz: the steepest piece of the curve is less than 4 times steeper than the diagonal.
    steepest = 4.0 * law.gains[INVERSE_WIDTH, level]
    difference = abs(psi(law, level, a) - psi(law, level, b))
    assert difference <= steepest * abs(a - b) + 1e-12


@given(any_law, levels, st.floats(1e-6, 2.0))
def test_slope_is_that_of_psi(law, level, share):
    width = 1.0 / law.gains[INVERSE_WIDTH, level]
    position = share * (KNOTS - 1)
    if abs(position - round(position)) < 1e-3:
        return  # two pieces meet
    a, step = share * width, 1e-6 * width
    _, slope = read_psi(law, level, a)
    rise = psi(law, level, a + step) - psi(law, level, a - step)
    np.testing.assert_allclose(slope, rise / (2.0 * step), rtol=1e-6, atol=1e-6 / width)


@given(st.sampled_from(list(LAWS)), levels, st.floats(0.0, 2.0), st.floats(1e-9, 1e9))
def test_width_scales_the_input(options, level, share, width):
    shape, normalise = options
    scaled = law((width,), fuzzy_shape=shape, fuzzy_normalise=normalise)
    unit = law((1.0,), fuzzy_shape=shape, fuzzy_normalise=normalise)
    expected = psi(unit, level, share)
    np.testing.assert_allclose(psi(scaled, level, share * width), expected, atol=1e-13)


@given(levels, st.floats(1e-300))
def test_sign_is_the_limit_of_a_narrow_psi(level, a):
    narrow = law((1e-12,))
    sign = law(variant='sign')
    assert read_psi(sign, level, a) == (1.0, 0.0)
    if a >= 1e-12:
        np.testing.assert_allclose(psi(narrow, level, a), 1.0, rtol=1e-12)
