# SPDX-License-Identifier: Apache-2.0
"""The scalar equation of an implicit level: its residual is small wherever one looks."""

from fhaosmo_ros.core.observer.cascade import Cascade
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest


def law(variant, lambda_, alpha, width, shape='triangle'):
    p = {'variant': variant, 'lambda': lambda_, 'alpha': alpha, 'fuzzy_widths': width}
    p |= {'fuzzy_systems': [f'terms {shape} 5', f'terms {shape} 7']}
    return Cascade(ObserverConfiguration(p))


def powers(low, high):
    """Return a strategy for numbers that are spread evenly over their orders of magnitude."""
    return st.floats(low, high).map(lambda x: 10.0**x)


def check(law, b, h, gamma, level):
    eps, s = law.solve(level, b, h, gamma)
    assert 0.0 <= eps <= b * (1.0 + 1e-15)
    assert 0.0 <= s <= 1.0
    damping = h * law.configuration.lambdas[level]
    stiffness = h * h * law.configuration.alphas[level]
    terms = np.array([eps, damping * eps**gamma * s, stiffness * s])
    # A relative error of x in eps leaves a residual of at most 2 x times the largest term.
    np.testing.assert_allclose(terms.sum(), b, rtol=1e-12)
    if eps > 0.0:  # s is in psi(eps)
        np.testing.assert_allclose(s, law.curve(level, eps)[0], rtol=1e-12)
    return eps, s


sizes = powers(-20.0, 6.0)
periods = powers(-7.0, 0.5)
gains = powers(-6.0, 6.0)
widths = powers(-12.0, 6.0)
gammas = st.sampled_from([0.5, 0.01, 0.1, 0.3, 0.67, 0.8, 1.0])
shapes = st.sampled_from(['triangle', 'gaussian'])


@settings(max_examples=500)
@given(sizes, periods, gammas, gains, gains, widths, shapes, st.integers(0, 1))
@example(1e-12, 1.0, 0.01, 1e6, 1e-6, 1e-12, 'triangle', 0)
@example(1e6, 1e-6, 1.0, 1e6, 1e6, 1e-12, 'triangle', 0)
@example(1.0, 1.0, 0.01, 1e6, 1e6, 1e6, 'gaussian', 1)
def test_fuzzy_root(b, h, gamma, lambda_, alpha, width, shape, level):
    check(law('fuzzy_adaptive', lambda_, alpha, width, shape), b, h, gamma, level)


@settings(max_examples=500)
@given(sizes, periods, gains, gains)
def test_sign_root(b, h, lambda_, alpha):
    eps, s = check(law('sign', lambda_, alpha, 1.0), b, h, 0.5, 0)  # no other power with sign
    stiffness = h * h * alpha
    if b <= stiffness:
        assert eps == 0.0  # sliding
    elif b > stiffness * (1.0 + 1e-9):
        assert s == 1.0
        assert eps > 0.0


@pytest.mark.parametrize('variant', ['sign', 'fuzzy_adaptive'])
def test_no_innovation_needs_no_injection(variant):
    for b in (0.0, 5e-324, 1e-310):
        eps, s = law(variant, 15.0, 30.0, 0.02).solve(0, b, 1e-3, 0.5)
        assert abs(eps) <= b
        assert abs(s) <= 1e-200


@given(sizes, st.floats(1.0, 10.0), periods, st.sampled_from(['sign', 'fuzzy_adaptive']))
def test_root_increases_with_the_right_side(b, factor, h, variant):
    cascade = law(variant, 15.0, 30.0, 0.02)
    (eps, s), (more, t) = (cascade.solve(0, x, h, 0.5) for x in (b, b * factor))
    assert more >= eps * (1.0 - 1e-12)
    assert t >= s * (1.0 - 1e-12)
