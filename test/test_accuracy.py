# SPDX-License-Identifier: Apache-2.0
"""What theorems promise: orders of accuracy, convergence, and the paper's finding on chatter."""

from fhaosmo_ros.core import Observer, Plant
from fhaosmo_ros.core.simulation.metrics import chatter, rms
import numpy as np
from observer_cases import levels_of
import pytest

# The paper's example and gains.
MODEL = {'order': 3, 'phi': ['0', '0', '-z3']}
GAINS = {'lambda': 15.0, 'alpha': 30.0, 'epsilon': 0.025, 'fuzzy_widths': [0.02]}
GAINS |= {'gamma_initial': 0.5, 'gamma_rate': 0.004, 'gamma_min': 0.05, 'gamma_max': 1.0}
GAINS |= {'initial_estimate': [0.05, 0.0, 0.05, 0.05]}
GAINS |= {'initial_internal': [0.05, 0.0, 0.0, 0.05]}
GAINS |= {'start_from_measurement': False, 'estimate_from': 'internal'}


def order(steps, errors):
    """Return the slope of the errors over the steps, both logarithmic."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


# Plant


NONLINEAR = {
    'order': 2,
    'phi': ['-0.5*z1*z1', 'sin(z1) - z2**3'],
    'initial_state': [1.0, -0.5],
    'disturbance': 'sine',
    'disturbance_amplitude': 2.0,
    'disturbance_omega': 3.0,
}


def test_plant_is_accurate_to_fourth_order():
    exact = Plant(NONLINEAR | {'integration_step': 1e-4}).sample(2.0).z
    steps = [0.1, 0.05, 0.025, 0.0125]
    errors = [
        np.linalg.norm(Plant(NONLINEAR | {'integration_step': h}).sample(2.0).z - exact)
        for h in steps
    ]
    assert 3.7 < order(steps, errors) < 4.5


def test_trajectory_does_not_depend_on_the_sampling_times():
    rng = np.random.default_rng(4)
    coarse = np.linspace(0.0, 3.0, 31)
    extra = rng.uniform(0.0, 3.0, 500)
    fine = np.unique(np.concatenate([coarse, extra]))
    p = NONLINEAR | {'integration_step': 0.01}
    one, other = Plant(p).simulate(coarse), Plant(p).simulate(fine)
    at = np.searchsorted(fine, coarse)
    np.testing.assert_array_equal(other.z[at], one.z)


# Observer, smooth case: an odd smooth psi, open gates, smooth y. Euler is then of order 1.


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


# The paper's example


def paper_errors(h, end=20.0, omega=1.0, **options):
    """Return t, the errors of z and d, and the estimated and true d."""
    p = MODEL | {'initial_state': 0.2, 'disturbance_omega': omega, 'integration_step': 1e-3}
    t = np.arange(round(end / h) + 1) * h
    truth = Plant(p).simulate(t)
    result = Observer(MODEL | GAINS | options).run(t, truth.y)
    return t, result.z - truth.z, result.unknown_input, truth.unknown_input


@pytest.mark.parametrize('variant', ['sign', 'fuzzy', 'fuzzy_adaptive'])
def test_states_converge_implicitly(variant):
    t, errors, _, _ = paper_errors(1e-3, variant=variant, scheme='implicit')
    late = t >= 10.0
    assert rms(errors[~late, 2]) > 10.0 * rms(errors[late, 2])  # it did start elsewhere
    assert max(rms(e) for e in errors[late].T) < 2e-3


@pytest.mark.parametrize('omega', [1.0, 5.0])
def test_error_of_the_unknown_input_shrinks_with_the_step(omega):
    steps, errors = [8e-3, 4e-3, 2e-3, 1e-3], []
    for h in steps:
        t, _, d, truth = paper_errors(h, omega=omega, variant='sign', scheme='implicit')
        errors.append(rms((d - truth)[t >= 10.0]))
    assert order(steps, errors) > 0.8
    assert errors[-1] < 1e-3 * omega  # amplitude of d: 0.1


def test_implicit_scheme_takes_the_chatter_out_of_sign():
    t, _, d, truth = paper_errors(1e-3, variant='sign', scheme='implicit')
    late = t >= 10.0
    np.testing.assert_allclose(chatter(d[late], truth[late]), 1.0, atol=0.05)
