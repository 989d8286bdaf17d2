# SPDX-License-Identifier: Apache-2.0
"""The curves psi against scikit-fuzzy's own control system, and what they promise."""

from pathlib import Path

from fhaosmo_ros.core import ConfigurationError
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.fuzzy import (
    curve,
    infer,
    KNOTS,
    read_system,
    SHAPES,
)  # fmt: skip
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


# The ends of the universe, knots, points between knots, the terms' peaks and crossings.
INPUTS = [0.0, 1 / 512, 0.1, 0.125, 0.2503, 1 / 3, 0.4, 0.5, 0.5001, 2 / 3, 0.77, 0.875, 0.99, 1.0]
P5, P7 = '-1 -0.4 0 0.4 1', '-0.9 -0.6 -0.2 0 0.2 0.6 0.9'
OWN = [
    (f'input {P5}; output {P7}; rules 1 3 4 5 7', 'triangle', 'triangle'),
    (f'input gaussian {P5}; output {P7}; rules 1 3 4 5 7', 'gaussian', 'triangle'),
    (f'input {P5}; output gaussian {P7}; rules 1 2 4 6 7', 'triangle', 'gaussian'),
    (f'input {P5}; output trapezoid {P7}; rules 1 3 4 5 7', 'triangle', 'trapezoid'),
    (f'input gaussian {P5}; output {P7}; rules 1 2 4 6 7', 'gaussian', 'triangle'),
]


def agree(text, simulation, inferred, between_knots):
    """
    Compare inference and curve with a control system of scikit-fuzzy.

    Where nothing is interpolated between knots, only the output grids differ.
    """

    def computed(x):
        simulation.input['eps'] = x
        simulation.compute()
        return simulation.output['psi']

    system, x = read_system(text), np.array(INPUTS)
    expected = np.array([computed(v) for v in x])
    for sign, wanted in (1.0, expected), (-1.0, [computed(-v) for v in x]):
        np.testing.assert_allclose(infer(sign * x, system), wanted, atol=inferred)
    own = law((1.0,), fuzzy_systems=[text])
    for x, value in zip(INPUTS, expected / expected[-1], strict=True):
        np.testing.assert_allclose(psi(own, 3, x), value, atol=between_knots)
        assert psi(own, 3, -x) == -psi(own, 3, x)


@pytest.mark.parametrize(('text', 'inputs', 'outputs'), OWN)
def test_own_system_agrees_with_a_control_system_of_scikit_fuzzy(text, inputs, outputs):
    rules = [int(k) for k in text.split('rules ')[1].split(';')[0].split()]
    p5, p7 = (np.array([float(v) for v in p.split()]) for p in (P5, P7))
    simulation = oracle((inputs, p5), (outputs, p7), rules)
    agree(text, simulation, inferred=1e-5, between_knots=5e-3)  # where corners are cut


@even
def test_even_system_agrees_with_a_control_system_of_scikit_fuzzy(terms, shape):
    side = shape, np.linspace(-1.0, 1.0, terms)
    simulation = oracle(side, side, range(1, terms + 1))
    # Knots are h = 1/192 apart, and every corner of a triangle's curve is one. A smooth curve
    # leaves the straight line between two of them by h^2 / 8 times its curvature, some 10, hence
    # 4e-5; triangles are steeper beside their peaks, trapezoids have corners between knots.
    between_knots = 1e-3 if shape == 'trapezoid' else 1.2e-4
    agree(f'terms {shape} {terms}', simulation, inferred=2e-6, between_knots=between_knots)


def test_singletons_and_samples_make_a_straight_line_between_them():
    """The weighted mean of singletons by memberships that are linear and add up to 1."""
    grid = np.linspace(0.0, 1.0, KNOTS)
    for text, x, values in (
        ('input -1 -0.25 0 0.25 1; output singleton -1 -0.6 0 0.6 1', [0, 0.25, 1], [0, 0.6, 1]),
        ('terms 7; output singleton 7', [0, 1], [0, 1]),
        ('curve 0 0.7 0.9', [0, 0.5, 1], [0, 0.7 / 0.9, 1]),
        ('curve 0,0.7,0.9', [0, 0.5, 1], [0, 0.7 / 0.9, 1]),
    ):
        np.testing.assert_allclose(curve(text), np.interp(grid, x, values), atol=1e-15)


REFUSED = {
    '': 'clauses terms', 'term 5': "got 'term'", 'terms 5; terms 7': 'each once',
    'terms 4': 'odd number of terms', 'terms 1': 'odd number of terms', 'terms 101': '3 to 99',
    'terms bell 5': 'triangle, trapezoid, gaussian',
    'terms singleton 5': 'triangle, trapezoid, gaussian', 'terms 1e400': 'numbers',
    'terms': 'numbers', 'input -1 0.4 0 1': '0.001 or more above',
    'input -1 -1e-300 0 1e-300 1': '0.001 or more above', 'input -2 0 2': 'within',
    'output 5': 'terms, input or curve',
    'terms 5; input 5; output 5': 'terms, or input and output',
    'terms 5; output 7': '5 and 7 terms', 'terms 5; rules 1 2 3 4': '5 rules',
    'terms 5; rules 1 2 3 4 6': 'from 1 to 5', 'terms 5; rules 1 2 3.5 4 5': '5 rules',
    'terms 5; defuzzify bisector': "got 'defuzzify'", 'input -1 -0.3 0 0.4 1': 'odd curve',
    'terms 5; rules 1 2 4 4 5': 'odd curve', 'terms 5; rules 5 4 3 2 1': 'does not fall',
    'terms 5; rules 1 4 3 2 5': 'does not fall', 'terms 5; rules 3 3 3 3 3': 'ends above 0',
    'curve 0': '2 samples', 'curve -1 0 1': 'the first one 0', 'curve 0.1 1': 'the first one 0',
    'curve 0 0.5 0.4': 'does not fall', 'curve 0 1 1.1': 'at most at 1',
    'curve 0 0 0': 'ends above 0', 'curve 0 nan': 'numbers',
    'curve 0 1; terms 5': 'curve by itself',
}  # fmt: skip


@pytest.mark.parametrize('text', REFUSED)
def test_bad_system_is_refused_with_the_reason(text):
    with pytest.raises(ConfigurationError) as caught:
        law((1.0,), fuzzy_systems=['terms 5', text])
    message = str(caught.value)
    assert message.startswith("parameter 'fuzzy_systems': expected ")
    assert REFUSED[text] in message
    assert message.endswith(f'in {text!r}')


numbers = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=5)
shapes = st.sampled_from(['', *SHAPES, 'singleton'])


@st.composite
def any_system(draw):
    """Return a text that may or may not be a system: peaks are mirrored, rules are not."""
    sides = []
    for side in ('input', 'output'):
        half = sorted({round(abs(v), 3) for v in draw(numbers)} - {0.0})
        peaks = [-v for v in reversed(half)] + [0.0] + half
        sides.append((side, draw(shapes), peaks))
    rules = draw(st.lists(st.integers(1, len(sides[1][2])), min_size=len(sides[0][2]),
                          max_size=len(sides[0][2])))  # fmt: skip
    clauses = [f'{side} {shape} {" ".join(map(str, peaks))}' for side, shape, peaks in sides]
    return '; '.join([*clauses, 'rules ' + ' '.join(map(str, sorted(rules)))])


@settings(max_examples=10)
@given(any_system())
def test_any_system_is_refused_or_keeps_the_promise(text):
    try:
        values = curve(text)
    except ConfigurationError:
        return
    assert (values.shape, values[0], values[-1]) == ((KNOTS,), 0.0, 1.0)
    assert np.all(np.diff(values) >= 0.0)


def test_last_width_and_system_serve_the_levels_that_follow():
    found = law((0.1, 0.4)).configuration
    np.testing.assert_array_equal(found.widths, [0.1, 0.4, 0.4, 0.4])
    np.testing.assert_array_equal(found.curves, [curve(f'terms {k}') for k in (5, 7, 7, 7)])
    with pytest.raises(ConfigurationError, match='1 to 4 values'):
        law(fuzzy_systems=['terms 5'] * 5)
    assert law(order=1, phi=['0'], unknown_input=False).levels == 1  # the default is not too long


LAWS = {
    shape: law((0.02, 0.5), fuzzy_systems=[f'terms {shape} 5', f'terms {shape} 7'])
    for shape in SHAPES
}
any_law = st.sampled_from(list(LAWS.values()))
levels = st.integers(0, 3)
inputs = st.floats(0.0, 1.0) | st.floats(0.0, 1e300)


@given(any_law, levels, inputs, inputs)
def test_psi_is_bounded_monotone_and_continuous(law, level, a, b):
    low, high = sorted([a, b])
    assert 0.0 <= psi(law, level, low) <= psi(law, level, high) <= 1.0
    # Lipschitz: the steepest piece of the curve is less than 5 times steeper than the diagonal.
    steepest = 5.0 / law.configuration.widths[level]
    assert psi(law, level, high) - psi(law, level, low) <= steepest * (high - low) + 1e-12


def test_systems_in_the_documents_are_accepted():
    page = Path(__file__).resolve().parents[1] / 'docs' / 'mathematics.md'
    example = page.read_text().split('    fuzzy_systems:\n', 1)[1].split('\n\n', 1)[0]
    systems = [line.strip().removeprefix('- ') for line in example.splitlines()]
    assert len(systems) == 3
    law(fuzzy_systems=systems)
