# SPDX-License-Identifier: Apache-2.0
"""The cascade: sensitivities, the law and the bounds of gamma, the root of an implicit level."""

from fhaosmo_ros.core import Observer, Status
from fhaosmo_ros.core.observer.cascade import Cascade
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
from observer_cases import levels_of, SMALL
import pytest

# Sensitivities and the gamma law, against finite differences of whole runs


MODELS = {
    'integrator': (['0'], 0.0),
    'paper': (['0', '0', '-z3'], 0.0),
    'nonlinear': (['-0.3*z1**3', 'sin(z2)*z1 + u', '-tanh(z3) - 0.2*z1*z2*z3*u'], 1.0),
}
Z_HAT, Z_TILDE, P, Q = range(4)
"""Rows of `levels_of`."""
HOLD = 1e-300
"""A learning rate that carries the sensitivities along and moves nothing; 0 does neither."""
DELTA = 1e-8
# Central differences: rounding is 1e-16 / DELTA, amplified some times over the run. A small DELTA
# makes it rarer that the two runs are on different straight pieces of psi's curve.
TOLERANCE = 1e-5


def make(model, scheme, gamma, **others):
    phi, _ = MODELS[model]
    p = {'order': len(phi), 'phi': phi, 'scheme': scheme, 'variant': 'fuzzy_adaptive'}
    p |= {'lambda': 4.0, 'alpha': 6.0, 'epsilon': 0.3, 'fuzzy_widths': [0.05, 0.2]}
    p |= {'gamma_initial': gamma, 'gamma_rate': HOLD, 'gamma_min': 0.1, 'gamma_max': 1.0}
    p |= {'initial_internal': 0.1, 'start_from_measurement': False}
    p |= {'gamma_dead_zone': 0.0, 'gamma_leakage': 0.0}
    return Observer(p | others)


def signals(model, steps=400):
    rng = np.random.default_rng(3)
    t = np.concatenate([[0.0], np.cumsum(5e-3 * rng.uniform(0.5, 1.5, steps))])
    y = 0.4 * np.sin(2.0 * t + 0.5) + 0.3 * np.exp(-(((t - 1.2) / 0.03) ** 2))
    return t, y, MODELS[model][1] * np.cos(3.0 * t)


cases = pytest.mark.parametrize('model', MODELS)
schemes = pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
gammas = pytest.mark.parametrize('gamma', [0.35, 0.5, 0.8])


@cases
@pytest.mark.parametrize('variant', ['fuzzy_adaptive', 'sign_adaptive'])
@schemes
@gammas
def test_sensitivities_are_the_derivatives_of_the_states(model, scheme, variant, gamma):
    if (scheme, variant) == ('explicit', 'sign_adaptive'):
        pytest.skip('explicitly the sensitivities of sign run away')
    powers = (gamma, gamma - DELTA, gamma + DELTA)
    observers = [make(model, scheme, g, variant=variant) for g in powers]
    t, y, u = signals(model)
    # Close to eps = 0 the powers of sign bend much within DELTA.
    close = {'rtol': TOLERANCE, 'atol': TOLERANCE}
    if variant.startswith('sign'):
        close = {'rtol': 5e-3, 'atol': 5e-3}
    opened, moved = set(), np.zeros(observers[0].levels)
    for part in np.array_split(np.arange(len(t)), 40):
        runs = [observer.run(t[part], y[part], u[part]) for observer in observers]
        middle, below, above = (levels_of(observer) for observer in observers)
        p = (above[Z_HAT] - below[Z_HAT]) / (2.0 * DELTA)
        q = (above[Z_TILDE] - below[Z_TILDE]) / (2.0 * DELTA)
        np.testing.assert_allclose(middle[P], p, **close)
        np.testing.assert_allclose(middle[Q], q, **close)
        moved = np.maximum(moved, np.abs(p))
        opened |= set(runs[0].open_levels)
    # There was something to compare, at every level.
    assert moved[: -1 if close['rtol'] > TOLERANCE else None].min() > 1e-4
    gates = model != 'integrator' and scheme == 'explicit'
    assert len(opened) > 1 or not gates


@cases
@schemes
@gammas
def test_gamma_moves_down_the_gradient_of_the_loss(model, scheme, gamma):
    t, y, u = signals(model)
    rate = 1e-3
    for k in (20, 120, 245, 400):
        # gamma_rate acts in the last step only.
        adaptive = make(model, scheme, gamma)
        adaptive.run(t[:k], y[:k], u[:k])
        adaptive.configure({'gamma_rate': rate})
        adaptive.run(t[k : k + 1], y[k : k + 1], u[k : k + 1])
        moved = adaptive.estimate.gamma - gamma

        # Explicit: L at the beginning of the interval, as everything in forward Euler.
        at = k - 1 if scheme == 'explicit' else k
        below, above = (
            np.sum(make(model, scheme, g).run(t, y, u).innovation[at] ** 2)
            for g in (gamma - DELTA, gamma + DELTA)
        )
        gradient = (above - below) / (2.0 * DELTA)
        # gamma itself rounds to 1e-16, so its move of h * rate * gradient is known to this.
        expected = -(t[k] - t[k - 1]) * rate * gradient
        np.testing.assert_allclose(moved, expected, rtol=1e-4, atol=1e-11)


@schemes
def test_change_of_variant_starts_the_sensitivities_at_zero(scheme):
    t, y, u = signals('paper')
    observer = make('paper', scheme, 0.5)
    observer.run(t[:100], y[:100], u[:100])
    assert np.any(levels_of(observer)[P] != 0.0)
    observer.configure({'variant': 'fuzzy'})
    observer.run(t[100:200], y[100:200], u[100:200])
    observer.configure({'variant': 'fuzzy_adaptive'})
    np.testing.assert_array_equal(levels_of(observer)[P:], 0.0)


# What bounds the adapted power


@pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
@pytest.mark.parametrize('bound', ['min', 'max'])
def test_saturated_gamma_is_flagged(scheme, bound):
    p = SMALL | {'variant': 'fuzzy_adaptive', 'scheme': scheme, 'gamma_initial': 0.5}
    p |= {'gamma_rate': 0.0, 'gamma_leakage': 100.0}
    observer = Observer(p)
    observer.start(0.0)
    assert not observer.step(0.1, 1e-3, 0.0).status
    target = {'min': {'gamma_initial': 0.4, 'gamma_min': 0.4}}.get(
        bound, {'gamma_initial': 0.7, 'gamma_max': 0.7}
    )
    observer.configure(target)
    for _ in range(1000):
        estimate = observer.step(0.1, 1e-3, 0.0)
    flag = {'min': Status.GAMMA_AT_MIN, 'max': Status.GAMMA_AT_MAX}[bound]
    np.testing.assert_allclose(estimate.gamma, target['gamma_initial'])
    observer.configure({'gamma_rate': 1e6})  # the gradient drives it to a bound, and beyond
    statuses = [observer.step(np.sin(0.1 * k), 1e-3, 0.0).status for k in range(300)]
    assert any(status & flag for status in statuses)
    assert not any(status.rejected for status in statuses)


@given(st.floats(0.0, 1e6), st.floats(0.0, 1e3), st.integers(0, 9), st.floats(1e-5, 10.0))
def test_gamma_stays_within_its_bounds(rate, leakage, seed, dt):
    p = SMALL | {'gamma_rate': rate, 'gamma_leakage': leakage, 'variant': 'fuzzy_adaptive'}
    for scheme in ('explicit', 'implicit'):
        observer = Observer(p | {'scheme': scheme})
        observer.start(0.0)
        for y in np.random.default_rng(seed).uniform(-1.0, 1.0, 50):
            assert 0.3 <= observer.step(y, dt, 0.0).gamma <= 0.8


@given(st.floats(0.0, 1e3), st.floats(1e-5, 10.0))
def test_leakage_never_overshoots(leakage, dt):
    p = SMALL | {'variant': 'fuzzy_adaptive', 'gamma_rate': 0.0, 'gamma_leakage': leakage}
    observer = Observer(p | {'gamma_initial': 0.7})
    observer.start(0.0)
    observer.configure({'gamma_initial': 0.4})
    gamma = [0.7] + [observer.step(0.0, dt, 0.0).gamma for _ in range(20)]
    assert np.all(np.diff(gamma) <= 1e-15)
    assert gamma[-1] >= 0.4 - 1e-12


# The scalar equation of an implicit level: its residual is small wherever one looks


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
exponents = st.sampled_from([0.5, 0.01, 0.1, 0.3, 0.67, 0.8, 1.0])
shapes = st.sampled_from(['triangle', 'gaussian'])


@settings(max_examples=500)
@given(sizes, periods, exponents, gains, gains, widths, shapes, st.integers(0, 1))
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
