# SPDX-License-Identifier: Apache-2.0
"""What theorems promise: orders of accuracy, convergence, and the paper's finding on chatter."""

from fhaosmo_ros.core import Observer, Plant
from fhaosmo_ros.core.simulation.metrics import chatter, rms, total_variation
import numpy as np
from observer_cases import levels_of
import pytest

# The paper's example and gains.
MODEL = {'order': 3, 'phi': ['0', '0', '-z3']}
GAINS = {
    'lambda': 15.0, 'alpha': 30.0, 'epsilon': 0.025, 'fuzzy_widths': [0.02], 'gamma_initial': 0.5,
    'gamma_rate': 0.004, 'gamma_min': 0.05, 'gamma_max': 1.0, 'start_from_measurement': False,
    'initial_estimate': [0.05, 0.0, 0.05, 0.05], 'initial_internal': [0.05, 0.0, 0.0, 0.05],
    'estimate_from': 'internal',
}  # fmt: skip


def order(steps, errors):
    """Return the slope of the errors over the steps, both logarithmic."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


NONLINEAR = {
    'order': 2, 'phi': ['-0.5*z1*z1', 'sin(z1) - z2**3'], 'initial_state': [1.0, -0.5],
    'disturbance': 'sine', 'disturbance_amplitude': 2.0, 'disturbance_omega': 3.0,
}  # fmt: skip


def test_plant_is_accurate_to_fourth_order():
    exact = Plant(NONLINEAR | {'integration_step': 1e-4}).sample(2.0).z
    steps = [0.1, 0.05, 0.025, 0.0125]
    errors = [
        np.linalg.norm(Plant(NONLINEAR | {'integration_step': h}).sample(2.0).z - exact)
        for h in steps
    ]
    assert 3.7 < order(steps, errors) < 4.5


def test_trajectory_does_not_depend_on_the_sampling_times():
    coarse = np.linspace(0.0, 3.0, 31)
    extra = np.random.default_rng(4).uniform(0.0, 3.0, 500)
    fine = np.unique(np.concatenate([coarse, extra]))
    p = NONLINEAR | {'integration_step': 0.01}
    one, other = Plant(p).simulate(coarse), Plant(p).simulate(fine)
    at = np.searchsorted(fine, coarse)
    np.testing.assert_array_equal(other.z[at], one.z)


# An odd smooth psi, open gates, smooth y: Euler is then of order 1.


def smooth_errors(scheme, variant, steps):
    """Return the errors at t = 1 against a step a hundred times finer, extrapolated."""
    p = {'order': 2, 'phi': ['0', '-z2*z1'], 'scheme': scheme, 'variant': variant}
    p |= {'lambda': 3.0, 'alpha': 2.0, 'epsilon': 1e6, 'fuzzy_widths': [3.0, 5.0, 5.0]}
    p |= {'fuzzy_systems': ['terms gaussian 5', 'terms gaussian 7']}
    p |= {'gamma_rate': 0.05, 'gamma_initial': 0.6}
    p |= {'initial_estimate': [0.5, -0.3, 0.2], 'start_from_measurement': False}

    def end(step):
        t = np.arange(round(1.0 / step) + 1) * step
        observer = Observer(p)
        result = observer.run(t, np.sin(2.0 * t))
        return np.concatenate([levels_of(observer).ravel(), [result.gamma[-1]]])

    finest = 1e-5
    exact = 2.0 * end(finest) - end(2.0 * finest)  # Richardson
    return np.abs([end(h) - exact for h in steps])


@pytest.mark.parametrize('variant', ['fuzzy', 'fuzzy_adaptive'])
@pytest.mark.parametrize('scheme', ['explicit', 'implicit'])
def test_observer_is_accurate_to_first_order_where_it_is_smooth(scheme, variant):
    steps = [0.02, 0.01, 0.005, 0.0025]
    errors = smooth_errors(scheme, variant, steps)
    # The states, their sensitivities and gamma, each by itself; what stays 0 stays out.
    moved = errors.max(axis=0) > 1e-9
    assert moved.sum() >= 6
    slopes = [order(steps, column) for column in errors[:, moved].T]
    np.testing.assert_allclose(slopes, 1.0, atol=0.25)


def paper_errors(h, omega=1.0, **options):
    """Return the errors of z and d, and d, estimated and true, once the observer has settled."""
    p = MODEL | {'initial_state': 0.2, 'disturbance_omega': omega, 'integration_step': 1e-3}
    t = np.arange(round(20.0 / h) + 1) * h
    truth, late = Plant(p).simulate(t), t >= 10.0
    result = Observer(MODEL | GAINS | {'scheme': 'implicit'} | options).run(t, truth.y)
    d, true = result.unknown_input[late], truth.unknown_input[late]
    return (result.z - truth.z)[late], d - true, d, true


@pytest.mark.parametrize('variant', ['sign', 'fuzzy', 'fuzzy_adaptive'])
def test_states_converge_implicitly(variant):
    errors, *_ = paper_errors(1e-3, variant=variant)
    assert max(rms(e) for e in errors.T) < 2e-3


@pytest.mark.parametrize('omega', [1.0, 5.0])
def test_error_of_the_unknown_input_shrinks_with_the_step(omega):
    steps = [8e-3, 4e-3, 2e-3, 1e-3]
    errors = [rms(paper_errors(h, omega, variant='sign')[1]) for h in steps]
    assert order(steps, errors) > 0.8
    assert errors[-1] < 1e-3 * omega  # amplitude of d: 0.1


def test_implicit_scheme_takes_the_chatter_out_of_sign():
    *_, d, truth = paper_errors(1e-3, variant='sign')
    np.testing.assert_allclose(chatter(d, truth), 1.0, atol=0.05)


def test_metrics_of_series_that_are_known_by_hand():
    np.testing.assert_allclose(rms(np.array([3.0, -4.0])), np.sqrt(12.5))
    assert np.isnan([rms(np.array([])), rms(np.array([1.0, np.nan]))]).all()
    assert total_variation(np.array([0.0, 2.0, -1.0, -1.0])) == 5.0
    assert total_variation(np.array([4.0])) == 0.0
    truth = np.sin(np.linspace(0.0, 10.0, 1001))
    np.testing.assert_allclose(chatter(0.5 * truth + 3.0, truth), 0.5)
    assert chatter(truth, np.ones(1001)) == np.inf
