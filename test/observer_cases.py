# SPDX-License-Identifier: Apache-2.0
"""Observers and samples that several tests share."""

import math

from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

# Every number that a test relies on; the defaults may change.
SMALL = {'order': 2, 'phi': ['0', '-z2*z2*z1 + u'], 'lambda': 3.0, 'alpha': 4.0}
SMALL |= {'epsilon': 0.025, 'fuzzy_widths': [0.02], 'unknown_input': True}
SMALL |= {'gamma_initial': 0.5, 'gamma_min': 0.3, 'gamma_rate': 0.004}
SMALL |= {'gamma_dead_zone': 0.0, 'gamma_leakage': 0.0, 'start_from_measurement': True}
VARIANTS = ('sign', 'fuzzy', 'fuzzy_adaptive', 'sign_adaptive')
FORMS = (('cascade', 'explicit'), ('cascade', 'implicit'), ('levant', 'predict_correct'))
LAWS = [
    {'structure': structure, 'scheme': scheme, 'variant': variant}
    for structure, scheme in FORMS for variant in VARIANTS
]  # fmt: skip
laws, cascades = (
    pytest.mark.parametrize('law', some, ids=lambda law: '-'.join(law.values()))
    for some in (LAWS, LAWS[:8])
)
any_law = st.sampled_from(LAWS)


def samples(count=200, seed=1):
    """Return t, y, u with NaNs and infinities, and a first sample that is bad."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.5e-3, 2e-3, count))
    y = np.sin(3.0 * t) + 1e-3 * rng.standard_normal(count)
    u = rng.uniform(-1.0, 1.0, count)
    y[[0, 1, 30, 31, 100]] = np.nan
    y[120], u[140] = np.inf, np.nan
    return t, y, u


def states_of(rates, d, start=0.0, period=1e-3):
    """Return the states of z' = A z + e_n d from sample to sample, d held."""
    n = len(rates)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[n - 1, n] = rates, 1.0
    step = expm(whole * period)
    z = np.empty((len(d), n))
    z[0] = start
    for k in range(1, len(d)):
        z[k] = step[:n, :n] @ z[k - 1] + step[:n, n] * d[k - 1]
    return z


def discrete(rates, drive, period):
    """Return transition and noise of x' = rates x + w over a period (Van Loan 1978)."""
    n = len(rates)
    whole = expm(np.block([[-rates, drive], [np.zeros_like(rates), rates.T]]) * period)
    transition = whole[n:, n:].T
    return transition, transition @ whole[:n, n:]


def matern(count, rate, derivatives, rng, period=1e-3):
    """Return a d of size 1 with so many derivatives, its corner at `rate` (rad/s)."""
    d = rng.standard_normal(count + 4000)
    for _ in range(derivatives + 1):
        d = lfilter([1.0], [1.0, -math.exp(-rate * period)], d)
    return d[4000:] / d[4000:].std()


def powers(low, high):
    """Return a strategy for numbers that are spread evenly over their orders of magnitude."""
    return st.floats(low, high).map(lambda x: 10.0**x)


def place(estimator, *values):
    """Put the estimates of z and d there, as if the observer had converged."""
    state, n = estimator.state_dict(), len(values) - 1
    for name in ('z_hat', 'z_tilde', 'p', 'q'):
        state[name][:] = 0.0
    state['z_hat'][: n + 1] = values[: len(state['z_hat'])]
    state['z_tilde'][:n] = values[1:]
    estimator.load_state_dict(state)


def levels_of(observer):
    """Return rows z_hat, z_tilde, p and q of all levels, a copy."""
    values = observer.structure.state_dict()
    return np.array([values[name] for name in ('z_hat', 'z_tilde', 'p', 'q')])


def remembered(observer, name):
    return observer.structure.state_dict()[name]


def state_of(observer):
    """Return all that an observer remembers."""
    return observer.structure.state_dict() | {'t': observer._t}


def assert_same_state(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name])
