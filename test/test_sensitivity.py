# SPDX-License-Identifier: Apache-2.0
"""The forward sensitivities and the gamma law, against finite differences of whole runs."""

from fhaosmo_ros.core import Observer
import numpy as np
from observer_cases import levels_of
import pytest

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
