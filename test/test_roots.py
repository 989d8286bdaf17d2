# SPDX-License-Identifier: Apache-2.0
"""Both structures: the bounds of gamma, the roots of implicit equations."""

from fhaosmo_ros.core import Observer, Status
from fhaosmo_ros.core.observer.cascade import Cascade
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.levant import Levant
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
from observer_cases import powers, SMALL, VARIANTS
import pytest


@given(
    st.sampled_from(['explicit', 'implicit']), st.floats(0.0, 1e6), st.floats(0.0, 1e3),
    st.integers(0, 9), st.floats(1e-5, 10.0),
)  # fmt: skip
def test_gamma_stays_within_its_bounds_which_are_flagged(scheme, rate, leakage, seed, dt):
    p = {'scheme': scheme, 'variant': 'fuzzy_adaptive', 'gamma_rate': rate}
    observer = Observer(SMALL | p | {'gamma_leakage': leakage})
    observer.start(0.0)
    for y in np.random.default_rng(seed).uniform(-1.0, 1.0, 50):
        estimate = observer.step(y, dt, 0.0)
        assert 0.3 <= estimate.gamma <= 0.8
        assert bool(estimate.status & Status.GAMMA_AT_MIN) == (estimate.gamma == 0.3)
        assert bool(estimate.status & Status.GAMMA_AT_MAX) == (estimate.gamma == 0.8)


@given(st.floats(0.0, 1e3), st.floats(1e-5, 10.0))
def test_leakage_never_overshoots(leakage, dt):
    own = {'variant': 'fuzzy_adaptive', 'gamma_rate': 0.0, 'gamma_leakage': leakage}
    observer = Observer(SMALL | own, gamma_initial=0.7)
    observer.start(0.0)
    observer.configure({'gamma_initial': 0.4})
    gamma = [0.7] + [observer.step(0.0, dt, 0.0).gamma for _ in range(20)]
    assert np.all(np.diff(gamma) <= 1e-15)
    assert gamma[-1] >= 0.4 - 1e-12


def law(variant, lambda_, alpha, width, shape='triangle'):
    p = {'variant': variant, 'lambda': lambda_, 'alpha': alpha, 'fuzzy_widths': width}
    p |= {'fuzzy_systems': [f'terms {shape} 5', f'terms {shape} 7']}
    return Cascade(ObserverConfiguration(p))


def check(law, b, h, gamma, level):
    """Check the scalar equation of an implicit level."""
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


sizes, periods, gains = powers(-20.0, 6.0), powers(-7.0, 0.5), powers(-6.0, 6.0)
exponents = st.sampled_from([0.5, 0.01, 0.1, 0.3, 0.67, 0.8, 1.0])
shapes, levels = st.sampled_from(['triangle', 'gaussian']), st.integers(0, 1)


@settings(max_examples=500)
@given(sizes, periods, exponents, gains, gains, powers(-12.0, 6.0), shapes, levels)
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
@pytest.mark.parametrize('b', [0.0, 5e-324, 1e-310])
def test_root_of_next_to_nothing(variant, b):
    eps, s = law(variant, 15.0, 30.0, 0.02).solve(0, b, 1e-3, 0.5)
    assert 0.0 <= eps <= b
    assert 0.0 <= s <= b / (30.0 * 1e-6)


@settings(max_examples=400)
@given(
    st.sampled_from(VARIANTS), powers(-20.0, 6.0), powers(-6.0, 0.5),
    powers(-3.0, 0.0) | st.sampled_from([1e-9, 1e-16, 1e-300]),
    st.lists(powers(-6.0, 6.0), min_size=4, max_size=4), powers(-9.0, 6.0),
)  # fmt: skip
def test_root_of_levants_structure(variant, b, h, gamma, lambdas, width):
    p = {'structure': 'levant', 'variant': variant, 'lambda': lambdas, 'fuzzy_widths': width}
    levant = Levant(ObserverConfiguration(p))
    weights = np.array(lambdas) * h ** np.arange(1, 5)
    eps, w, top = levant.solve(weights, b, gamma)
    s = np.array([levant.curve(i, eps)[0] for i in range(4)]) if eps > 0.0 else np.zeros(4)
    assert eps == 0.0 or s[3] == top
    if eps > 1e-299:
        np.testing.assert_allclose(w, eps ** (gamma / 2.0), rtol=1e-12)
    s[3] = top
    assert np.all((s >= 0.0) & (s <= 1.0))
    terms = np.append(weights * w ** np.arange(3, -1, -1) * s, eps)
    np.testing.assert_allclose(terms.sum(), b, rtol=1e-11)
