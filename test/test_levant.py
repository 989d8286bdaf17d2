# SPDX-License-Identifier: Apache-2.0
"""
The second structure, against its equations written down a second time, and its theorems.

The reference is plain Python made from docs/mathematics.md, not from the kernels: scipy's brentq
solves the implicit equations, its solve_ivp follows the model.
"""

import math

from fhaosmo_ros.core import Observer, Plant
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.fuzzy import curves
from fhaosmo_ros.core.observer.levant import Levant
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from observer_cases import powers, VARIANTS
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

PHI = {
    1: (['-0.5*z1 + u'], [lambda z, u: -0.5 * z[0] + u]),
    3: (
        ['sin(z1)', 'u*z2', '-z3 - z1*tanh(z3)'],
        [
            lambda z, u: math.sin(z[0]), lambda z, u: u * z[1],
            lambda z, u: -z[2] - z[0] * math.tanh(z[2]),
        ],
    ),
}  # fmt: skip
INTEGRATORS = {'structure': 'levant', 'order': 3, 'phi': ['0'] * 3, 'variant': 'sign'}
# Levant's gains for a last derivative bounded by L: lambda_i = C_i L^(i / N).
COEFFICIENTS = {
    2: (1.5, 1.1), 4: (3.0, 4.16, 3.06, 1.1), 6: (7.0, 23.72, 32.24, 20.26, 6.75, 1.1),
}  # fmt: skip
SCHEMES = ['implicit', 'predict_correct']
WIDTHS = [0.3, 0.05]


def gains(levels, bound):
    return [c * bound ** ((i + 1) / levels) for i, c in enumerate(COEFFICIENTS[levels])]


def parameters(n, derivatives=0, **others):
    levels = n + 1 + derivatives
    return {
        'structure': 'levant', 'order': n, 'phi': PHI[n][0], 'lambda': gains(levels, 3.0),
        'unknown_input_derivatives': derivatives, 'unknown_input_decay': 0.0,
        'fuzzy_widths': WIDTHS, 'gamma_initial': 0.7, 'gamma_rate': 10.0, 'gamma_leakage': 1.0,
        'initial_estimate': list(np.linspace(0.1, -0.2, levels)), 'start_from_measurement': False,
    } | others  # fmt: skip


def signals(steps=100):
    rng = np.random.default_rng(7)
    t = np.concatenate([[0.0], np.cumsum(4e-3 * rng.uniform(0.5, 1.5, steps))])
    return t, 0.3 * np.sin(2.0 * t) + 0.2 * np.sign(np.sin(9.0 * t)), np.cos(3.0 * t)


class Reference:
    """z_hat_i' = z_hat_{i+1} + Phi_i + lambda_i |eps|^(2 gamma (N - i) / N) psi_i(eps)."""

    def __init__(self, p, gamma):
        self.n = p['order']
        self.N = self.n + 1 + p['unknown_input_derivatives']
        self.gains, self.gamma = p['lambda'], gamma
        self.decay = p['unknown_input_decay']
        self.sign = p['variant'].startswith('sign')
        self.phi = PHI[self.n][1]
        self.z = np.array(p['initial_estimate'])
        self.curves = curves(OBSERVER_PARAMETERS.defaults(), self.N)

    def psi(self, i, e):
        if self.sign:
            return np.sign(e)
        values = self.curves[i]
        grid = np.linspace(0.0, WIDTHS[min(i, 1)], len(values))
        return math.copysign(np.interp(abs(e), grid, values), e)

    def injections(self, e):
        powers = [2.0 * self.gamma * (self.N - i) / self.N for i in range(1, self.N + 1)]
        terms = zip(self.gains, powers, strict=True)
        return np.array([g * abs(e) ** p * self.psi(i, e) for i, (g, p) in enumerate(terms)])

    def known(self, y, u):
        return self.model(np.array([y, *self.z[1:]]), u)

    def model(self, point, u):
        return np.array([*(f(point, u) for f in self.phi), *(-self.decay * point[self.n :])])

    def implicit(self, y, h, u):
        """Solve (1 - h shift) z = old + h (Phi + injections(y - z_1)) for z."""
        chain = np.eye(self.N) - h * np.eye(self.N, k=1)
        drift = self.z + h * self.known(y, u)
        self.correct(y, lambda v: np.linalg.solve(chain, drift + h * v), h**self.N)

    def predict_correct(self, y, h, u):
        """
        Follow the model, then share each injection out like the correction of a deadbeat observer.

        Ackermann's formula gives it for the shortest chain that the injection belongs to.
        """

        def rates(_, z):
            return np.append(z[1:], 0.0) + self.model(z, u)

        end = solve_ivp(rates, (0.0, h), self.z, 'DOP853', rtol=1e-13, atol=1e-13).y[:, -1]
        held = np.zeros((self.N, self.N))
        whole = expm(h * np.eye(self.N, k=1))
        for j in range(1, self.N + 1):
            step = whole[:j, :j]
            seen = np.array([(step[:1] @ np.linalg.matrix_power(step, k))[0] for k in range(j)])
            gain = np.linalg.matrix_power(step, j) @ np.linalg.solve(seen, np.eye(j)[-1])
            held[:j, j - 1] = gain * h**j  # the first state takes all: gain[0] = 1
        self.correct(y, lambda v: end + held @ v, h**self.N)

    def correct(self, y, state, reach_of_last):
        """Find the injections v for which y - state(v)_1 is the innovation that they belong to."""

        def gap(e):  # decreases with e
            return y - state(self.injections(e))[0] - e

        b = y - state(np.zeros(self.N))[0]
        last = np.eye(self.N)[-1] * self.gains[-1]
        reach = y - state(last * np.sign(b))[0]
        if self.sign and b * reach <= 0.0:  # the set-valued last sign can take it all
            self.z = state(last * b / (self.gains[-1] * reach_of_last))
            return
        e = brentq(gap, math.copysign(1e-300, b), b, xtol=1e-300, rtol=4 * np.finfo(float).eps)
        self.z = state(self.injections(e))


@pytest.mark.parametrize('derivatives', [0, 2])
@pytest.mark.parametrize('decay', [0.0, 5.0])
@pytest.mark.parametrize('n', [1, 3])
@pytest.mark.parametrize('variant', VARIANTS)
@pytest.mark.parametrize('scheme', SCHEMES)
def test_run_follows_the_equations(scheme, variant, n, decay, derivatives):
    p = parameters(n, derivatives, scheme=scheme, variant=variant, unknown_input_decay=decay)
    t, y, u = signals()
    result = Observer(p).run(t, y, u)
    reference = Reference(p, 0.7 if variant.endswith('adaptive') else 0.5)
    z = [reference.z]
    for k in range(1, len(t)):
        getattr(reference, scheme)(y[k], t[k] - t[k - 1], u[k])
        z.append(reference.z)
    np.testing.assert_allclose(result.z_hat, z, rtol=1e-7, atol=1e-7)
    assert np.ptp(result.z_hat, axis=0).min() > 0.1  # every level moved
    np.testing.assert_array_equal(result.z_tilde[1:, :-1], result.z_hat[1:, 1:])
    np.testing.assert_array_equal(result.z, result.z_hat[:, :n])
    np.testing.assert_array_equal(result.unknown_input, result.z_hat[:, n])
    np.testing.assert_allclose(result.innovation[:, 0], y - result.z_hat[:, 0])
    np.testing.assert_array_equal(result.innovation[1:, 1:], 0.0)
    np.testing.assert_array_equal(result.gamma, reference.gamma)  # nothing moves it here


def test_two_levels_are_the_super_twisting_pair():
    """With psi = sign: the first level of the paper's cascade, with alpha_1 = lambda_2."""
    t, y, u = signals()
    p = {'order': 1, 'phi': ['0'], 'variant': 'sign', 'scheme': 'implicit'}
    pair = Observer(p | {'structure': 'levant', 'lambda': [4.0, 6.0]}).run(t, y, u)
    level = Observer(p | {'unknown_input': False, 'lambda': 4.0, 'alpha': 6.0}).run(t, y, u)
    np.testing.assert_allclose(pair.z, level.z, atol=1e-9)
    np.testing.assert_allclose(pair.unknown_input, level.unknown_input, atol=1e-9)


@pytest.mark.parametrize(
    ('scheme', 'h'), [('implicit', 1e-3), ('implicit', 1e-2), ('predict_correct', 1e-2)]
)
def test_polynomial_of_the_observers_degree_is_followed_exactly(scheme, h):
    """Its fourth derivative is 0, which is less than any bound L > 0: nothing is left."""
    p = INTEGRATORS | {'scheme': scheme, 'lambda': gains(4, 1.0), 'prediction_step': h}
    t = np.arange(round(20.0 / h)) * h
    polynomial = np.polynomial.Polynomial([0.5, -0.3, 0.04, 0.005])
    run, late = Observer(p).run(t, polynomial(t)), t > 15.0
    rounding = 10.0 * np.finfo(float).eps * polynomial(t[-1])
    for i in range(4):
        error = np.abs(run.z_hat[late, i] - polynomial.deriv(i)(t[late])).max()
        # Backward differences are exact but for the step: an error of order h in the derivatives.
        backward = scheme == 'implicit' and 0 < i < 3
        assert error < (2.0 * h if backward else rounding / h**i)


@pytest.mark.parametrize('variant', VARIANTS)
@pytest.mark.parametrize('h', [1e-3, 2e-2])
def test_predict_correct_stays_on_the_truth(variant, h):
    """From the true state, with a d that its model allows for, nothing is left to correct."""
    phi, start, d = PHI[3][0], [0.2, -0.1, 0.3], 0.4
    t = np.arange(round(2.0 / h)) * h
    u = np.cos(3.0 * t)
    plant = {'phi': phi, 'initial_state': start, 'integration_step': 1e-3}
    truth = Plant(plant | {'disturbance': 'step', 'disturbance_offset': d,
                           'disturbance_amplitude': 0.0}).simulate(t, u)  # fmt: skip
    p = parameters(3, scheme='predict_correct', variant=variant)
    run = Observer(p | {'initial_estimate': [*start, d]}).run(t, truth.y, u)
    np.testing.assert_allclose(run.z, truth.z, atol=1e-7)
    np.testing.assert_allclose(run.unknown_input, d, atol=1e-4)
    # An Euler scheme does not: its error is of the order of the step.
    euler = Observer(p | {'initial_estimate': [*start, d], 'scheme': 'implicit'})
    assert np.abs(euler.run(t, truth.y, u).z - truth.z).max() > 1e-2 * h


@pytest.mark.parametrize('variant', VARIANTS)
def test_prediction_step_divides_a_long_interval(variant):
    p = parameters(3, scheme='predict_correct', variant=variant)
    t, y, u = np.array([0.0, 0.4]), np.array([0.3, 0.2]), np.array([0.0, 0.5])
    coarse, fine, finer = (
        Observer(p | {'prediction_step': h}).run(t, y, u).z[-1] for h in (0.4, 0.02, 0.01)
    )
    np.testing.assert_allclose(fine, finer, rtol=1e-6)
    assert np.abs(coarse - finer).max() > 30.0 * np.abs(fine - finer).max()


@pytest.mark.parametrize('scheme', SCHEMES)
def test_errors_shrink_with_the_step_as_levants_theorem_says(scheme):
    """|error of z_i| <= mu_i L^(..) h^(N - i + 1); here at least order 1."""
    steps, errors = [8e-3, 4e-3, 2e-3], []
    for h in steps:
        t = np.arange(round(20.0 / h)) * h
        run = Observer(INTEGRATORS | {'scheme': scheme, 'lambda': gains(4, 1.5)}).run(t, np.sin(t))
        truth = np.stack([np.sin(t), np.cos(t), -np.sin(t), -np.cos(t)], axis=1)
        errors.append([rms(e) for e in (run.z_hat - truth)[t > 10.0].T])
    for error in np.transpose(errors):
        assert max(error) < 1e-12 or np.polyfit(np.log(steps), np.log(error), 1)[0] > 0.8


@settings(max_examples=40)
@given(st.floats(1e-3, 1e3), st.sampled_from(SCHEMES))
def test_sign_is_homogeneous(scale, scheme):
    """Time scaled by k, y by k^N: z_hat_i scales by k^(N - i + 1) (degree -1)."""
    p = INTEGRATORS | {'scheme': scheme, 'lambda': gains(4, 3.0)}
    t, y, _ = signals(50)
    one = Observer(p).run(t, y).z_hat
    other = Observer(p).run(scale * t, scale**4 * y).z_hat
    weights = scale ** np.arange(4.0, 0.0, -1.0)
    np.testing.assert_allclose(other / weights, one, rtol=1e-6, atol=1e-6 * np.abs(one).max())


@settings(max_examples=400)
@given(
    st.sampled_from(VARIANTS), powers(-20.0, 6.0), powers(-6.0, 0.5),
    powers(-3.0, 0.0) | st.sampled_from([1e-9, 1e-16, 1e-300]),
    st.lists(powers(-6.0, 6.0), min_size=4, max_size=4), powers(-9.0, 6.0),
)  # fmt: skip
def test_root(variant, b, h, gamma, lambdas, width):
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


@pytest.mark.parametrize('scheme', SCHEMES)
def test_gamma_of_next_to_nothing_is_the_limit_of_small_ones(scheme):
    p = {'structure': 'levant', 'scheme': scheme, 'variant': 'fuzzy_adaptive', 'gamma_rate': 0.0}
    p |= {'lambda': [39.75, 276.3, 1498.0, 3260.0], 'fuzzy_widths': 4.0}
    t = np.arange(0.0, 1.0, 1e-3)
    small, smaller, *rest = (
        Observer(p | {'gamma_min': gamma, 'gamma_initial': gamma}).run(t, np.sin(t)).z_hat
        for gamma in (1e-6, 1e-9, 1e-12, 1e-15, 1e-18, 1e-300)
    )
    error = np.abs(small - smaller).max()
    assert 0.0 < error < 1e-2
    for z_hat in rest:
        np.testing.assert_allclose(z_hat, smaller, rtol=0.0, atol=2e-3 * error)
