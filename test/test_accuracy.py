# SPDX-License-Identifier: Apache-2.0
"""What theorems promise: orders of accuracy, convergence, and the paper's finding on chatter."""

from fhaosmo_ros.core import Observer, Plant
from fhaosmo_ros.core.simulation.metrics import chatter, rms
import numpy as np
import pytest

# The paper's example and gains.
MODEL = {'order': 3, 'phi': ['0', '0', '-z3']}
GAINS = {'lambda': 15.0, 'alpha': 30.0, 'epsilon': 0.025, 'scheme': 'implicit', 'variant': 'sign'}
# Levant's gains for four levels: C_i L^(i / 4) for a last derivative bounded by L.
LEVANT = {
    'structure': 'levant', 'order': 3, 'phi': ['0'] * 3, 'variant': 'sign',
    'lambda': [c * 1.5 ** (i / 4) for i, c in enumerate((3.0, 4.16, 3.06, 1.1), 1)],
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


@pytest.mark.parametrize('omega', [1.0, 5.0])
def test_error_of_the_unknown_input_shrinks_with_the_step_and_sign_does_not_chatter(omega):
    p = MODEL | {'initial_state': 0.2, 'disturbance_omega': omega, 'integration_step': 1e-3}
    steps, runs = [8e-3, 4e-3, 2e-3, 1e-3], []
    for h in steps:
        t = np.arange(round(20.0 / h) + 1) * h
        truth, late = Plant(p).simulate(t), t >= 10.0
        found = Observer(MODEL | GAINS).run(t, truth.y)
        runs.append((found.unknown_input[late], truth.unknown_input[late]))
    errors = [rms(d - truth) for d, truth in runs]
    assert order(steps, errors) > 0.8
    assert errors[-1] < 1e-3 * omega  # amplitude of d: 0.1
    np.testing.assert_allclose(chatter(*runs[-1]), 1.0, atol=0.05)


def test_errors_shrink_with_the_step_as_levants_theorem_says():
    """|error of z_i| <= mu_i L^(..) h^(N - i + 1); here at least order 1."""
    steps, errors = [8e-3, 4e-3, 2e-3], []
    for h in steps:
        t = np.arange(round(20.0 / h)) * h
        run = Observer(LEVANT).run(t, np.sin(t))
        truth = np.stack([np.sin(t), np.cos(t), -np.sin(t), -np.cos(t)], axis=1)
        errors.append([rms(e) for e in (run.z_hat - truth)[t > 10.0].T])
    for error in np.transpose(errors):
        assert max(error) < 1e-12 or order(steps, error) > 0.8


def test_metrics_of_series_that_are_known_by_hand():
    np.testing.assert_allclose(rms(np.array([3.0, -4.0])), np.sqrt(12.5))
    assert np.isnan([rms(np.array([])), rms(np.array([1.0, np.nan]))]).all()
    assert chatter(np.array([0.0, 2.0, -1.0, -1.0]), np.arange(3.0)) == 2.5
    truth = np.sin(np.linspace(0.0, 10.0, 1001))
    np.testing.assert_allclose(chatter(0.5 * truth + 3.0, truth), 0.5)
    assert chatter(truth, np.ones(1001)) == np.inf
