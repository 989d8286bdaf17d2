# SPDX-License-Identifier: Apache-2.0
"""The curves psi against scikit-fuzzy's own control system, and what they promise."""

from pathlib import Path

from fhaosmo_ros.core import ConfigurationError
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.fuzzy import curve, infer, KNOTS, SHAPES
from fhaosmo_ros.core.observer.observer import make_structure
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import skfuzzy
from skfuzzy import control

# scikit-fuzzy 0.5.0 with numpy 2.4
pytestmark = pytest.mark.filterwarnings('ignore:Passing more than 2 positional')

EVEN = [(terms, shape) for terms in (5, 7) for shape in SHAPES]
even = pytest.mark.parametrize(('terms', 'shape'), EVEN)


def law(level_widths=(0.02,), **options):
    p = {'variant': 'fuzzy', 'fuzzy_widths': list(level_widths)}
    return make_structure(ObserverConfiguration(p | options))


def psi(law, level, x):
    """Return psi of a signed x, as the compiled functions read it."""
    value, _ = law.curve(level, abs(x))
    return np.copysign(value, x)


def peak_shapes(universe, shape, peaks):
    """Return membership functions by the definition in docs/mathematics.md."""
    rows = []
    for k, c in enumerate(peaks):
        low = peaks[k - 1] if k else 2 * c - peaks[1]
        high = peaks[k + 1] if k + 1 < len(peaks) else 2 * c - peaks[-2]
        if shape == 'triangle':
            row = skfuzzy.trimf(universe, [low, c, high])
        elif shape == 'trapezoid':  # 1 over half of the way to the neighbours
            quarters = [0.25 * c + 0.75 * low, 0.75 * c + 0.25 * low,
                        0.75 * c + 0.25 * high, 0.25 * c + 0.75 * high]  # fmt: skip
            row = skfuzzy.trapmf(universe, quarters)
        else:  # neighbours cross at 1/2
            sigmas = np.array([c - low, high - c]) / 2 / np.sqrt(2 * np.log(2))
            row = skfuzzy.gaussmf(universe, c, np.where(universe <= c, *sigmas))
        rows.append(row)
    rows[0][universe < peaks[0]] = 1.0
    rows[-1][universe > peaks[-1]] = 1.0
    return rows


def oracle(inputs, outputs, rules):
    """Return a rule base as a control system of scikit-fuzzy; inputs: shape and peaks."""
    # The grid interpolates an input's memberships and holds the output's; its spacing must fit
    # the peaks of the terms, which lie at multiples of 1/2, 1/3 and 1/10.
    universe = np.linspace(-1.0, 1.0, 12001)
    eps, out = control.Antecedent(universe, 'eps'), control.Consequent(universe, 'psi')
    for variable, terms in ((eps, inputs), (out, outputs)):
        for k, row in enumerate(peak_shapes(universe, *terms)):
            variable[f't{k + 1}'] = row
    rules = [control.Rule(eps[f't{k + 1}'], out[f't{j}']) for k, j in enumerate(rules)]
    return control.ControlSystemSimulation(control.ControlSystem(rules))


def computed(simulation, x):
    simulation.input['eps'] = x
    simulation.compute()
    return simulation.output['psi']


# The ends of the universe, knots, points between knots, the terms' peaks and crossings.
INPUTS = [0.0, 1 / 512, 0.1, 0.125, 0.2503, 1 / 3, 0.4, 0.5, 0.5001, 2 / 3, 0.77, 0.875, 0.99, 1.0]


@even
def test_inference_and_curve_agree_with_a_control_system_of_scikit_fuzzy(terms, shape):
    """Where nothing is interpolated between knots, only the output grids differ."""
    text, side = f'terms {shape} {terms}', (shape, np.linspace(-1.0, 1.0, terms))
    simulation = oracle(side, side, range(1, terms + 1))
    expected = np.array([computed(simulation, x) for x in INPUTS])
    mirrored = [computed(simulation, -x) for x in INPUTS]
    found = [infer(sign * np.array(INPUTS), shape, terms) for sign in (1.0, -1.0)]
    np.testing.assert_allclose(found, [expected, mirrored], atol=2e-6)
    # Knots are h = 1/192 apart, and every corner of a triangle's curve is one. A smooth curve
    # leaves the straight line between two of them by h^2 / 8 times its curvature, some 10, hence
    # 4e-5; triangles are steeper beside their peaks, trapezoids have corners between knots.
    between_knots = 1e-3 if shape == 'trapezoid' else 1.2e-4
    own = law((1.0,), fuzzy_systems=[text])
    for x, value in zip(INPUTS, expected / expected[-1], strict=True):
        np.testing.assert_allclose(psi(own, 3, x), value, atol=between_knots)
        assert psi(own, 3, -x) == -psi(own, 3, x)


def test_sampled_curve_is_interpolated_and_mirrored():
    grid = np.linspace(0.0, 1.0, KNOTS)
    whole = curve('curve 0 0.7 0.9')
    np.testing.assert_allclose(whole, np.interp(grid, [0, 0.5, 1], [0, 0.7 / 0.9, 1]))
    np.testing.assert_array_equal(whole, curve('curve 0,0.7,0.9'))


REFUSED = {
    '': 'terms [triangle',
    'term 5': "got 'term'",
    'terms 4': 'odd number of terms',
    'terms 1': 'odd number of terms',
    'terms 101': '3 to 99',
    'terms -1 0 1': 'odd number of terms',
    'terms bell 5': 'triangle, trapezoid, gaussian',
    'terms 1e400': 'numbers',
    'terms': 'numbers',
    'terms 5; rules 1 2 3 4 5': 'numbers',
    'input 5': "got 'input'",
    'curve 0': '2 samples',
    'curve -1 0 1': 'the first one 0',
    'curve 0.1 0.5 1': 'the first one 0',
    'curve 0 0.5 0.4': 'does not fall',
    'curve 0 1 1.1': 'at most at 1',
    'curve 0 0 0': 'ends above 0',
    'curve 0 nan': 'numbers',
    'curve': 'numbers',
}


@pytest.mark.parametrize('text', REFUSED)
def test_bad_system_is_refused_with_the_reason(text):
    with pytest.raises(ConfigurationError) as caught:
        law((1.0,), fuzzy_systems=['terms 5', text])
    message = str(caught.value)
    assert message.startswith("parameter 'fuzzy_systems': expected ")
    assert REFUSED[text] in message
    assert message.endswith(f'in {text!r}')


@settings(max_examples=10)
@given(st.sampled_from(list(SHAPES)), st.integers(1, 49).map(lambda half: 2 * half + 1))
def test_curve_of_terms_is_refused_or_keeps_the_promise(shape, terms):
    try:
        values = curve(f'terms {shape} {terms}')
    except ConfigurationError:
        return
    assert values.shape == (KNOTS,)
    assert values[0] == 0.0
    assert np.all(np.diff(values) >= 0.0)
    assert values[-1] == 1.0


@pytest.mark.parametrize(('terms', 'end'), [(5, 5.0 / 6.0), (7, 8.0 / 9.0)])
def test_centroid_alone_falls_short_of_1(terms, end):
    # The centroid of the outermost half triangle, a third of its base away from 1.
    np.testing.assert_allclose(infer(np.ones(1), 'triangle', terms), end, atol=1e-6)


def test_level_1_has_5_terms_and_the_others_7():
    curves = law().configuration.curves
    np.testing.assert_array_equal(curves[0], curve('terms 5'))
    for row in curves[1:]:
        np.testing.assert_array_equal(row, curve('terms 7'))


def test_more_systems_than_levels_are_refused():
    with pytest.raises(ConfigurationError, match='1 to 4 values'):
        law(fuzzy_systems=['terms 5'] * 5)
    assert law(order=1, phi=['0'], unknown_input=False).levels == 1  # the default is not


def test_last_width_serves_the_levels_that_follow():
    widths = law((0.1, 0.4)).configuration.widths
    np.testing.assert_array_equal(widths, [0.1, 0.4, 0.4, 0.4])


LAWS = {
    shape: law((0.02, 0.5), fuzzy_systems=[f'terms {shape} 5', f'terms {shape} 7'])
    for shape in SHAPES
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
    # Lipschitz: the steepest piece of the curve is less than 5 times steeper than the diagonal.
    steepest = 5.0 / law.configuration.widths[level]
    difference = abs(psi(law, level, a) - psi(law, level, b))
    assert difference <= steepest * abs(a - b) + 1e-12


@given(any_law, levels, st.floats(1e-6, 2.0))
def test_slope_is_that_of_psi(law, level, share):
    width = law.configuration.widths[level]
    position = share * (KNOTS - 1)
    if abs(position - round(position)) < 1e-3:
        return  # two pieces meet
    a, step = share * width, 1e-6 * width
    _, slope = law.curve(level, a)
    rise = psi(law, level, a + step) - psi(law, level, a - step)
    np.testing.assert_allclose(slope, rise / (2.0 * step), rtol=1e-6, atol=1e-6 / width)


@given(st.sampled_from(list(LAWS)), levels, st.floats(0.0, 2.0), st.floats(1e-9, 1e9))
def test_width_scales_the_input(shape, level, share, width):
    scaled = law((width,), fuzzy_systems=[f'terms {shape} 5'])
    unit = law((1.0,), fuzzy_systems=[f'terms {shape} 5'])
    expected = psi(unit, level, share)
    np.testing.assert_allclose(psi(scaled, level, share * width), expected, atol=1e-13)


@given(levels, st.floats(1e-300))
def test_sign_is_the_limit_of_a_narrow_psi(level, a):
    narrow = law((1e-12,))
    sign = law(variant='sign')
    assert sign.curve(level, a) == (1.0, 0.0)
    if a >= 1e-12:
        np.testing.assert_allclose(psi(narrow, level, a), 1.0, rtol=1e-12)


def test_systems_in_the_documents_are_accepted():
    page = Path(__file__).resolve().parents[1] / 'docs' / 'mathematics.md'
    example = page.read_text().split('    fuzzy_systems:\n', 1)[1].split('\n\n', 1)[0]
    systems = [line.strip().removeprefix('- ') for line in example.splitlines()]
    assert len(systems) == 3
    law(fuzzy_systems=systems)
