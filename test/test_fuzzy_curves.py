# SPDX-License-Identifier: Apache-2.0
"""The curves psi against scikit-fuzzy's own control system, and what is refused."""

from fhaosmo_ros.core import ConfigurationError
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.fuzzy import curve, infer, KNOTS, read_system
from fhaosmo_ros.core.observer.observer import make_structure
import numpy as np
import pytest
import skfuzzy
from skfuzzy import control

# scikit-fuzzy 0.5.0 with numpy 2.4
pytestmark = pytest.mark.filterwarnings('ignore:Passing more than 2 positional')


def law(level_widths=(0.02,), **options):
    p = {'variant': 'fuzzy', 'fuzzy_widths': list(level_widths)}
    return make_structure(ObserverConfiguration(p | options))


def memberships(universe, shape, peaks):
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


def oracle(system):
    """Return psi of a system, not normalised, by a control system of scikit-fuzzy."""
    # The grid interpolates an input's memberships and holds the output's; its spacing must fit
    # the peaks of the terms, which lie at multiples of 1/2, 1/3 and 1/10.
    universe = np.linspace(-1.0, 1.0, 12001)
    eps, out = control.Antecedent(universe, 'eps'), control.Consequent(universe, 'psi')
    for variable, terms in ((eps, system.inputs), (out, system.outputs)):
        for k, row in enumerate(memberships(universe, *terms)):
            variable[f't{k + 1}'] = row
    rules = [control.Rule(eps[f't{k + 1}'], out[f't{j + 1}']) for k, j in enumerate(system.rules)]
    simulation = control.ControlSystemSimulation(control.ControlSystem(rules))

    def psi(x):
        simulation.input['eps'] = x
        simulation.compute()
        return simulation.output['psi']

    return psi


# The ends of the universe, knots, points between knots, the terms' peaks and crossings.
INPUTS = [0.0, 1 / 512, 0.1, 0.125, 0.2503, 1 / 3, 0.4, 0.5, 0.5001, 2 / 3, 0.77, 0.875, 0.99, 1.0]
P5, P7 = '-1 -0.4 0 0.4 1', '-0.9 -0.6 -0.2 0 0.2 0.6 0.9'


def test_text_is_read_as_a_system():
    found = read_system(f'input 3; output gaussian {P5}; rules 1 3 5')
    peaks = (-1.0, -0.4, 0.0, 0.4, 1.0)
    assert found == (('triangle', (-1.0, 0.0, 1.0)), ('gaussian', peaks), (0, 2, 4))


@pytest.mark.parametrize(('text', 'inferred', 'between_knots'), [
    # Knots are h = 1/192 apart, and every corner of an even triangle's curve is one. A smooth
    # curve leaves the straight line between two of them by h^2 / 8 times its curvature, some 10,
    # hence 4e-5; triangles are steeper beside their peaks, trapezoids have corners between knots.
    ('terms triangle 5', 2e-6, 1.2e-4), ('terms gaussian 7', 2e-6, 1.2e-4),
    ('terms trapezoid 5', 2e-6, 1e-3),
    # Corners of other peaks are cut.
    (f'input gaussian {P5}; output trapezoid {P7}; rules 1 2 4 6 7', 1e-5, 5e-3),
    (f'input triangle {P5}; output gaussian {P7}; rules 1 3 4 5 7', 1e-5, 5e-3),
])  # fmt: skip
def test_system_agrees_with_a_control_system_of_scikit_fuzzy(text, inferred, between_knots):
    """Where nothing is interpolated between knots, only the output grids differ."""
    system, x = read_system(text), np.array(INPUTS)
    psi = oracle(system)
    expected = np.array([psi(v) for v in x])
    for sign, wanted in (1.0, expected), (-1.0, [psi(-v) for v in x]):
        np.testing.assert_allclose(infer(sign * x, system), wanted, atol=inferred)
    found = np.interp(x, np.linspace(0.0, 1.0, KNOTS), curve(text))
    np.testing.assert_allclose(found, expected / expected[-1], atol=between_knots)


def test_singletons_and_samples_make_a_straight_line_between_them():
    """The weighted mean of singletons by memberships that are linear and add up to 1."""
    grid = np.linspace(0.0, 1.0, KNOTS)
    for text, x, values in (
        ('input -1 -0.25 0 0.25 1; output singleton -1 -0.6 0 0.6 1', [0, 0.25, 1], [0, 0.6, 1]),
        ('terms 7; output singleton 7', [0, 1], [0, 1]),
        ('terms 3; output singleton 5; rules 1 3 5', [0, 1], [0, 1]),
        ('curve 0, 0.7 0.9', [0, 0.5, 1], [0, 0.7 / 0.9, 1]),
    ):
        np.testing.assert_allclose(curve(text), np.interp(grid, x, values), atol=1e-15)


REFUSED = {
    'term 5': "got 'term'", 'terms 5; terms 7': 'each once', 'terms 4': 'odd number of terms',
    'terms 101': '3 to 99', 'terms singleton 5': 'triangle, trapezoid, gaussian',
    'terms 1e400': 'numbers', 'input -1 -1e-300 0 1e-300 1': '0.001 or more above',
    'input -2 0 2': 'within', 'output 5': 'terms, input or curve',
    'terms 5; input 5; output 5': 'terms, or input and output',
    'terms 5; output 7': '5 and 7 terms', 'terms 5; rules 1 2 3 4': '5 rules',
    'terms 5; rules 1 2 3.5 4 6': 'from 1 to 5', 'terms 5; rules 1 2 4 4 5': 'odd curve',
    'terms 5; rules 1 4 3 2 5': 'does not fall', 'terms 5; rules 3 3 3 3 3': 'ends above 0',
    'curve 0': '2 samples', 'curve 0.1 1': 'the first one 0', 'curve 0 0.5 0.4': 'does not fall',
    'curve 0 1 1.1': 'at most at 1', 'curve 0 1; terms 5': 'curve by itself',
}  # fmt: skip


@pytest.mark.parametrize('text', REFUSED)
def test_bad_system_is_refused_with_the_reason(text):
    with pytest.raises(ConfigurationError) as caught:
        law((1.0,), fuzzy_systems=['terms 5', text])
    message = str(caught.value)
    assert message.startswith("parameter 'fuzzy_systems': expected ")
    assert REFUSED[text] in message
    assert message.endswith(f'in {text!r}')


def test_last_width_and_system_serve_the_levels_that_follow():
    found = law((0.1, 0.4)).configuration
    np.testing.assert_array_equal(found.widths, [0.1, 0.4, 0.4, 0.4])
    np.testing.assert_array_equal(found.curves, [curve(f'terms {k}') for k in (5, 7, 7, 7)])
    assert law(order=1, phi=['0'], unknown_input=False).levels == 1  # the default is not too long
