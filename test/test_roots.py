# SPDX-License-Identifier: Apache-2.0
"""Both structures: the bounds of gamma, the roots of implicit equations."""

from fhaosmo_ros.core import Observer, Status
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
from observer_cases import powers, SMALL
import pytest
from scipy.optimize import brentq


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
        assert 0.3 <= estimate.gamma <= 1.0
        assert bool(estimate.status & Status.GAMMA_AT_MIN) == (estimate.gamma == 0.3)
        assert bool(estimate.status & Status.GAMMA_AT_MAX) == (estimate.gamma == 1.0)


@given(st.floats(0.0, 1e3), st.floats(1e-5, 10.0))
def test_leakage_never_overshoots(leakage, dt):
    own = {'variant': 'fuzzy_adaptive', 'gamma_rate': 0.0, 'gamma_leakage': leakage}
    observer = Observer(SMALL | own, gamma_initial=0.7)
    observer.start(0.0)
    observer.configure({'gamma_initial': 0.4})
    gamma = [0.7] + [observer.step(0.0, dt, 0.0).gamma for _ in range(20)]
    assert np.all(np.diff(gamma) <= 1e-15)
    assert gamma[-1] >= 0.4 - 1e-12


# The scalar equation of an implicit level: its residual is small wherever one looks


def law(variant, lambda_, alpha, width, system='terms 5', gamma=0.5):
    """Return an observer of one level, whose implicit step solves one equation."""
    return Observer({
        'order': 1, 'phi': ['0'], 'unknown_input': False, 'variant': variant, 'lambda': lambda_,
        'alpha': alpha, 'fuzzy_widths': width, 'fuzzy_systems': [system],
        'gamma_initial': gamma, 'gamma_min': gamma, 'gamma_rate': 0.0,
    })  # fmt: skip


def solve(law, b, h):
    """Return |eps| and s, by a step from z_hat_1 = -b to y = 0."""
    law.start(-b)
    estimate = law.step(0.0, h)
    return -estimate.z[0], estimate.unknown_input / (h * law.parameters['alpha'][0])


def psi(law, level, eps):
    curve, width = law.configuration.curves[level], law.configuration.widths[level]
    return np.interp(eps / width, np.linspace(0.0, 1.0, len(curve)), curve)


def check(law, b, h):
    eps, s = solve(law, b, h)
    p = law.parameters
    assert 0.0 <= eps <= b * (1.0 + 1e-15)
    assert 0.0 <= s <= 1.0 + 1e-15
    damping, stiffness = h * p['lambda'][0], h * h * p['alpha'][0]
    terms = np.array([eps, damping * eps ** p['gamma_initial'] * s, stiffness * s])
    # A relative error of x in eps leaves a residual of at most 2 x times the largest term.
    np.testing.assert_allclose(terms.sum(), b, rtol=1e-12)
    if eps > 0.0:  # s is in psi(eps)
        np.testing.assert_allclose(s, psi(law, 0, eps), rtol=1e-12)
    return eps, s


sizes, periods, gains = powers(-20.0, 6.0), powers(-7.0, 0.5), powers(-6.0, 6.0)
exponents = st.sampled_from([0.5, 0.01, 0.1, 0.3, 0.67, 0.8, 1.0])
systems = st.sampled_from([f'terms {shape} {k}' for shape in ('', 'gaussian') for k in (5, 7)])


@settings(max_examples=500)
@given(sizes, periods, exponents, gains, gains, powers(-12.0, 6.0), systems)
@example(1e-12, 1.0, 0.01, 1e6, 1e-6, 1e-12, 'terms 5')
@example(1e6, 1e-6, 1.0, 1e6, 1e6, 1e-12, 'terms 5')
@example(1.0, 1.0, 0.01, 1e6, 1e6, 1e6, 'terms gaussian 7')
def test_fuzzy_root(b, h, gamma, lambda_, alpha, width, system):
    check(law('fuzzy_adaptive', lambda_, alpha, width, system, gamma), b, h)


@settings(max_examples=500)
@given(sizes, periods, gains, gains)
def test_sign_root(b, h, lambda_, alpha):
    eps, s = check(law('sign', lambda_, alpha, 1.0), b, h)
    stiffness = h * h * alpha
    if b <= stiffness:
        assert eps == 0.0  # sliding
    elif b > stiffness * (1.0 + 1e-9):
        assert s == pytest.approx(1.0, rel=1e-15)
        assert eps > 0.0


@pytest.mark.parametrize('variant', ['sign', 'fuzzy_adaptive'])
@pytest.mark.parametrize('b', [0.0, 5e-324, 1e-310])
def test_root_of_next_to_nothing(variant, b):
    eps, s = solve(law(variant, 15.0, 30.0, 0.02), b, 1e-3)
    assert 0.0 <= eps <= b
    assert 0.0 <= s <= b / (30.0 * 1e-6)


@settings(max_examples=400)
@given(
    st.sampled_from(['sign_adaptive', 'fuzzy_adaptive']), powers(-20.0, 6.0), powers(-6.0, 0.5),
    powers(-3.0, 0.0) | st.sampled_from([1e-9, 1e-16, 1e-300]),
    st.lists(powers(-6.0, 6.0), min_size=4, max_size=4), powers(-9.0, 6.0),
)  # fmt: skip
def test_root_of_levants_structure(variant, b, h, gamma, lambdas, width):
    p = {'structure': 'levant', 'variant': variant, 'lambda': lambdas, 'fuzzy_widths': width}
    p |= {'phi': ['0'] * 3, 'gamma_initial': gamma, 'gamma_min': gamma}
    levant = Observer(p)
    levant.start(-b)
    estimate = levant.step(0.0, h)
    eps, top = -estimate.z[0], estimate.unknown_input / (h * lambdas[3])
    weights = np.array(lambdas) * h ** np.arange(1, 5)
    s = np.array([psi(levant, i, eps) for i in range(4)])
    if eps > 1e-299:
        assert top == pytest.approx(s[3], rel=1e-12)
        w = eps ** (gamma / 2.0)
    elif eps > 0.0:  # smaller than a double can be, but w = eps^(gamma / 2) is not
        w = brentq(lambda w: np.polyval(weights, w) - b, 0.0, 1.0, xtol=1e-300)
    else:
        w = 0.0
    s[3] = top
    assert np.all((s >= 0.0) & (s <= 1.0 + 1e-15))
    terms = np.append(weights * w ** np.arange(3, -1, -1) * s, eps)
    np.testing.assert_allclose(terms.sum(), b, rtol=1e-11)
    shares = [1.0, 3.0 / 2.0, 11.0 / 6.0]  # of the second level, beta of D 18
    np.testing.assert_allclose(h * estimate.z[1], shares @ terms[1:4], rtol=1e-9)
