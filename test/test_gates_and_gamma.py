# SPDX-License-Identifier: Apache-2.0
"""Which levels run, and what bounds the adapted power."""

from fhaosmo_ros.core import Observer, Status
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from observer_cases import SMALL
import pytest


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
