# SPDX-License-Identifier: Apache-2.0
"""
The compiled recursions against their equations, written down a second time.

The references below are plain Python, made from the paper and from docs/mathematics.md, not from
the kernels: scipy's brentq solves the implicit equations, its solve_ivp follows the model. Numbers
of the cascade are complex: the imaginary part is STEP times the derivative to gamma, so that the
sensitivities come out of the arithmetic instead of out of variational equations (complex-step
derivatives; Squire and Trapp 1998).
"""

import cmath
import math

from fhaosmo_ros.core import Observer
from fhaosmo_ros.core.observer.fuzzy import curves
import numpy as np
from observer_cases import levels_of, VARIANTS
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

STEP = 1e-30
"""Its square is 0 beside any number here, so that derivatives are exact."""


def slope(x):
    return x.imag / STEP


# Expressions for the observer, and the same functions for the reference.
PHI = {
    1: (['-0.5*z1 + u'], [lambda z, u: -0.5 * z[0] + u]),
    2: (
        ['sin(z1)', '-z2*z2*z1 - 0.3*u'],
        [lambda z, u: cmath.sin(z[0]), lambda z, u: -z[1] * z[1] * z[0] - 0.3 * u],
    ),
    4: (
        ['0.1*z1', 'u*sin(z2)', '-0.2*z1*z3', 'tanh(z4)*z2 - u*z3'],
        [
            lambda z, u: 0.1 * z[0],
            lambda z, u: u * cmath.sin(z[1]),
            lambda z, u: -0.2 * z[0] * z[2],
            lambda z, u: cmath.tanh(z[3]) * z[1] - u * z[2],
        ],
    ),
}


class Reference:
    """What the structures share: Phi, the power, and psi."""

    def __init__(self, p, levels):
        self.p, self.N, self.phi = p, levels, PHI[p['order']][1]
        self.sign = p['variant'].startswith('sign')
        self.gamma = p['gamma_initial'] if p['variant'].endswith('_adaptive') else 0.5
        self.curves = curves(p, levels)

    def psi(self, i, x):
        if self.sign:
            return complex(np.sign(x.real))
        widths = self.p['fuzzy_widths']
        width = widths[min(i, len(widths) - 1)]
        grid = np.linspace(0.0, width, len(self.curves[i]))
        a = abs(x.real)
        value = math.copysign(np.interp(a, grid, self.curves[i]), x.real)
        if a >= width:
            return complex(value)
        k = int(np.searchsorted(grid, a, side='right')) - 1
        rise = (self.curves[i][k + 1] - self.curves[i][k]) / (grid[k + 1] - grid[k])
        return complex(value, rise * x.imag)


def root(function, low, high):
    """Return it to the last bit: what is left must not grow to the tolerance within a run."""
    return brentq(function, low, high, xtol=1e-300, rtol=4 * np.finfo(float).eps)


class Cascade(Reference):
    """Plain recursion of D 2 to D 10 and D 17."""

    def __init__(self, p, y):
        super().__init__(p, p['order'] + p['unknown_input'])
        kappa = p['unknown_input_decay']
        # z_{n+1}' = -kappa z_{n+1} + eta
        self.phi = [*self.phi, lambda z, u: -kappa * z[p['order']]]
        self.decay = [kappa if i == p['order'] - 1 else 0.0 for i in range(p['order'] + 1)]
        self.hat = [complex(v) for v in p['initial_estimate']]
        self.tilde = [complex(v) for v in p['initial_internal']]  # tilde[i] is z_tilde_{i+2}
        if p['start_from_measurement']:
            self.hat[0] = complex(y)
        self.y = y

    def injection(self, i, eps, gamma):
        """Return |eps|^gamma psi(eps), 0 at 0."""
        if eps.real == 0.0:
            return 0j
        return (eps * math.copysign(1.0, eps.real)) ** gamma * self.psi(i, eps)

    def explicit(self, y, h, u):
        """Forward Euler: everything at the interval's beginning, y of the sample before."""
        p, gamma = self.p, complex(self.gamma, STEP)
        m = [complex(self.y), *self.tilde[: self.N - 1]]
        eps = [m[i] - self.hat[i] for i in range(self.N)]
        hat, tilde = list(self.hat), list(self.tilde)
        for i in range(self.N):
            if any(abs(e.real) > p['epsilon'] for e in eps[:i]):
                continue
            rate = self.tilde[i] + p['lambda'][i] * self.injection(i, eps[i], gamma)
            hat[i] = self.hat[i] + h * (rate + self.phi[i](m[: i + 1], u))
            forced = p['alpha'][i] * self.psi(i, eps[i])
            tilde[i] = self.tilde[i] + h * (forced - self.decay[i] * self.tilde[i])
        self.hat, self.tilde = hat, tilde
        self.adapt(eps, h)

    def implicit(self, y, h, u):
        """Backward Euler: level after level, everything at the interval's end."""
        p, gamma = self.p, complex(self.gamma, STEP)
        eps, m = [], []
        for i in range(self.N):
            m.append(complex(y) if i == 0 else self.tilde[i - 1])
            if any(abs(e.real) > p['epsilon'] for e in eps):
                eps.append(m[i] - self.hat[i])
                continue
            kept = 1.0 / (1.0 + h * self.decay[i])
            b = m[i] - self.hat[i] - h * (kept * self.tilde[i] + self.phi[i](m, u))
            e, s = self.solve(i, b, h, gamma)
            eps.append(e)
            self.tilde[i] = kept * (self.tilde[i] + h * p['alpha'][i] * s)
            self.hat[i] = m[i] - e
        self.adapt(eps, h)

    def solve(self, i, b, h, gamma):
        stiffness = h * h * self.p['alpha'][i] / (1.0 + h * self.decay[i])
        if self.sign and abs(b.real) <= stiffness:
            return 0j, b / stiffness

        def balance(e, gamma, b):
            injection = h * self.p['lambda'][i] * self.injection(i, e, gamma)
            return e + injection + stiffness * self.psi(i, e) - b

        least = math.copysign(1e-300 if self.sign else 0.0, b.real)
        e = root(lambda e: balance(complex(e), gamma, b).real, least, b.real)
        to_e = slope(balance(complex(e, STEP), self.gamma, b.real))
        to_gamma = slope(balance(complex(e), gamma, b))
        eps = complex(e, -STEP * to_gamma / to_e)  # implicit function theorem
        return eps, self.psi(i, eps)

    def adapt(self, eps, h):
        p = self.p
        if not p['variant'].endswith('_adaptive'):
            return
        loss = sum(e * e for e in eps)
        gamma = self.gamma
        rests = loss.real <= p['gamma_dead_zone'] ** 2
        if rests or p['gamma_dead_zone'] == 0.0:
            gamma -= h * p['gamma_leakage'] * (gamma - p['gamma_initial'])
        if not rests:
            gamma -= h * p['gamma_rate'] * slope(loss)
        self.gamma = min(max(gamma, p['gamma_min']), 1.0)

    def open(self):
        m = [self.y, *(v.real for v in self.tilde[: self.N - 1])]
        closed = [i for i in range(self.N - 1) if abs(m[i] - self.hat[i].real) > self.p['epsilon']]
        return 1 + min(closed, default=self.N - 1)


class Levant(Reference):
    """z_hat_i' = z_hat_{i+1} + Phi_i + lambda_i |eps|^(2 gamma (N - i) / N) psi_i(eps)."""

    def __init__(self, p):
        super().__init__(p, p['order'] + 1 + p['unknown_input_derivatives'])
        self.z = np.array(p['initial_estimate'])

    def injections(self, e):
        powers = [2.0 * self.gamma * (self.N - i) / self.N for i in range(1, self.N + 1)]
        terms = zip(self.p['lambda'], powers, strict=True)
        return np.array([g * abs(e) ** p * self.psi(i, e).real for i, (g, p) in enumerate(terms)])

    def model(self, point, u):
        decays = -self.p['unknown_input_decay'] * point[self.p['order'] :]
        return np.array([*(f(point, u).real for f in self.phi), *decays])

    def step(self, y, h, u):
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
        gain = self.p['lambda'][-1]
        last = np.eye(self.N)[-1] * gain
        reach = y - state(last * np.sign(b))[0]
        if self.sign and b * reach <= 0.0:  # the set-valued last sign can take it all
            self.z = state(last * b / (gain * reach_of_last))
            return
        e = root(gap, math.copysign(1e-300, b), b)
        self.z = state(self.injections(e))


def parameters(n, extra, **others):
    rng = np.random.default_rng(n)
    levels = n + extra
    return {
        'order': n, 'phi': PHI[n][0], 'unknown_input': extra, 'unknown_input_decay': 0.0,
        'lambda': list(3.0 + 2.0 * rng.random(levels)),
        'alpha': list(4.0 + 3.0 * rng.random(levels)),
        'epsilon': 0.2, 'fuzzy_widths': [0.05, 0.3][:levels],
        'fuzzy_systems': ['terms 5', 'terms 7'], 'gamma_initial': 0.5,
        'gamma_rate': 0.5,  # fast, so that gamma matters within the horizon
        'gamma_min': 0.2, 'gamma_dead_zone': 0.0, 'gamma_leakage': 0.0,
        'initial_estimate': list(rng.uniform(-0.2, 0.2, levels)),
        'initial_internal': list(rng.uniform(-0.2, 0.2, levels)),
        'start_from_measurement': False,
    } | others  # fmt: skip


def signals(steps=300):
    """Jittered times, a smooth y with bumps that close gates, and a known input."""
    rng = np.random.default_rng(7)
    t = np.concatenate([[0.0], np.cumsum(4e-3 * rng.uniform(0.5, 1.5, steps))])
    y = 0.3 * np.sin(2.0 * t) + 0.6 * np.exp(-(((t - 0.6) / 0.02) ** 2))
    return t, y, np.cos(3.0 * t)


def compare(p):
    (t, y, u), rtol = signals(), 1e-9
    observer, reference = Observer(p), Cascade(p, y[0])
    result = observer.run(t, y, u)
    rows = []
    for k in range(len(t)):
        if k > 0:
            getattr(reference, p['scheme'])(y[k], t[k] - t[k - 1], u[k])
            reference.y = y[k]
        rows.append([*reference.hat, *reference.tilde, reference.gamma, reference.open()])
    found = [result.z_hat, result.z_tilde, result.gamma, result.open_levels]
    np.testing.assert_allclose(np.column_stack(found), np.real(rows), rtol=rtol, atol=rtol)
    if p['variant'].endswith('_adaptive') and p['gamma_rate'] > 0.0:
        sensitivities = [[slope(v) for v in row] for row in (reference.hat, reference.tilde)]
        np.testing.assert_allclose(levels_of(observer)[2:], sensitivities, rtol=rtol, atol=rtol)
    return result


@pytest.mark.parametrize('extra', [False, True], ids=['N=n', 'N=n+1'])
@pytest.mark.parametrize('n', [1, 2, 4])
@pytest.mark.parametrize('variant', VARIANTS)
@pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
def test_cascade_follows_the_equations(scheme, variant, n, extra):
    p = parameters(n, extra, scheme=scheme, variant=variant)
    result = compare(p)
    assert np.ptp(result.z_hat, axis=0).min() > 1e-3  # every level moved
    if n + extra > 1:
        assert len(set(result.open_levels)) > 1  # and gates opened and closed
    if variant.endswith('_adaptive'):
        assert np.ptp(result.gamma) > 1e-3


@pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
@pytest.mark.parametrize('options', [
    {'gamma_rate': 0.0, 'gamma_initial': 0.7},
    {'gamma_leakage': 2.0},
    {'gamma_dead_zone': 0.1, 'gamma_leakage': 3.0},
    {'gamma_min': 0.499},
    {'gamma_initial': 0.999},
    {'gamma_rate': 0.0, 'gamma_leakage': 5.0, 'gamma_initial': 0.31, 'gamma_min': 0.3},
    {'fuzzy_systems': ['terms gaussian 5', 'terms trapezoid 7']},
    {'start_from_measurement': True, 'fuzzy_widths': [0.02]},
    {'epsilon': 1e3, 'unknown_input_decay': 5.0},
    {'epsilon': 1e3, 'unknown_input_decay': 5.0, 'unknown_input': False},
], ids='-'.join)  # fmt: skip
def test_options_of_the_cascade_follow_the_equations(scheme, options):
    extra = options.get('unknown_input', True)
    compare(parameters(2, extra, scheme=scheme, variant='fuzzy_adaptive') | options)


@pytest.mark.parametrize('derivatives', [0, 2])
@pytest.mark.parametrize(
    ('decay', 'off', 'moved'), [(0.0, 1e-7, 0.1), (5.0, 1e-7, 0.1), (2e3, 2e-3, 0.04)]
)
@pytest.mark.parametrize('n', [1, 2])
@pytest.mark.parametrize('variant', VARIANTS)
def test_levant_follows_the_equations(variant, n, decay, off, moved, derivatives):
    levels = n + 1 + derivatives
    p = parameters(n, True, variant=variant, unknown_input_decay=decay) | {
        'structure': 'levant', 'unknown_input_derivatives': derivatives, 'gamma_initial': 0.7,
        'lambda': [2.0 * 3.0 ** (i + 1) for i in range(levels)], 'alpha': [1.0],
        'initial_estimate': list(np.linspace(0.1, -0.2, levels)), 'initial_internal': [0.0],
    }  # fmt: skip
    t, y, u = signals(100)
    y += 0.2 * np.sign(np.sin(9.0 * t))
    result, reference = Observer(p).run(t, y, u), Levant(p)
    z = [reference.z]
    for k in range(1, len(t)):
        reference.step(y[k], t[k] - t[k - 1], u[k])
        z.append(reference.z)
    np.testing.assert_allclose(result.z_hat, z, rtol=off, atol=off)
    assert np.ptp(result.z_hat, axis=0).min() > moved  # every level
    np.testing.assert_array_equal(result.z_tilde[1:, :-1], result.z_hat[1:, 1:])
    np.testing.assert_array_equal(result.z, result.z_hat[:, :n])
    np.testing.assert_array_equal(result.unknown_input, result.z_hat[:, n])
    np.testing.assert_allclose(result.innovation[:, 0], y - result.z_hat[:, 0])
    np.testing.assert_array_equal(result.innovation[1:, 1:], 0.0)
    np.testing.assert_array_equal(result.gamma, reference.gamma)  # nothing moves it here
