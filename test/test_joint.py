# SPDX-License-Identifier: Apache-2.0
"""Plant and observer as one system: order of the solvers, agreement with the sampled observer."""

from itertools import pairwise

from fhaosmo_ros.core import Observer
import numpy as np
import pytest
from studies.paper.plant_and_observer import simulate

OBSERVER = {
    'lambda': 15, 'alpha': 30, 'epsilon': 0.5, 'fuzzy_widths': [0.5],
    'fuzzy_systems': ['terms gaussian 5', 'terms gaussian 7'],
    'gamma_initial': 0.5, 'gamma_rate': 0.01, 'initial_estimate': [0.1, 0.2, 0.2, 0.05],
    'initial_internal': [0.2, 0.2, 0.05, 0.0], 'start_from_measurement': False,
}  # fmt: skip
PLANT = {'disturbance_omega': 5.0}


@pytest.mark.parametrize('variant', ['sign', 'fuzzy', 'fuzzy_adaptive'])
def test_euler_is_the_explicit_scheme_fed_with_an_euler_plant(variant):
    observer = OBSERVER | {'variant': variant}
    step = 1e-3
    run = simulate(observer, PLANT, 'ode1', step, duration=0.3)
    z = np.empty_like(run.z)
    z[0] = 0.2
    for k, d in enumerate(run.unknown_input[:-1]):
        z1, z2, z3 = z[k]
        z[k + 1] = z1 + step * z2, z2 + step * z3, z3 + step * (d - z3)
    np.testing.assert_allclose(run.z, z, rtol=1e-12)
    sampled = Observer(observer | {'scheme': 'explicit'}).run(run.t, run.z[:, 0])
    np.testing.assert_allclose(run.z_hat, sampled.z_hat, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.z_tilde, sampled.z_tilde, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.gamma, sampled.gamma, rtol=1e-9)
    assert (run.gamma[-1] != 0.5) == (variant == 'fuzzy_adaptive')


@pytest.mark.parametrize(('solver', 'order'), [('ode1', 1), ('ode3', 3), ('ode4', 4)])
def test_solvers_have_their_order(solver, order):
    """On a smooth problem: the plant alone, against its closed solution."""
    phi = {'order': 1, 'phi': ['-z1']}
    errors = []
    for step in (0.1, 0.05, 0.025, 0.0125):
        run = simulate(
            phi | {'gains': 'fixed'}, phi | {'disturbance_omega': 2.0}, solver, step, duration=2.0
        )
        # z' = -z + 0.1 sin 2t, z(0) = 0.2
        exact = 0.24 * np.exp(-run.t) + 0.02 * np.sin(2 * run.t) - 0.04 * np.cos(2 * run.t)
        errors.append(np.abs(run.z[:, 0] - exact).max())
    slopes = [np.log2(coarse / fine) for coarse, fine in pairwise(errors)]
    assert slopes[-1] == pytest.approx(order, abs=0.2)


def test_held_signs_are_those_at_the_beginning_of_a_step():
    """Two steps of a chain with lambda -> 0: theta moves by h alpha times the held sign."""
    chain = {'order': 1, 'phi': ['0'], 'initial_state': [1e-5], 'disturbance': 'none'}
    p = {'variant': 'sign', 'order': 1, 'phi': ['0'], 'epsilon': 1.0}
    p |= {'lambda': [1e-9, 1.0], 'alpha': 1.0, 'initial_estimate': [0.0, 1.0]}
    p |= {'initial_internal': [1.0, 0.0], 'start_from_measurement': False}
    one, held = (simulate(p, chain, s, 1e-2, duration=1e-2) for s in ('ode4', 'ode4 held'))
    # eps_1 changes its sign within the step, between its first two stages.
    moved = [run.z_tilde[-1, 0] - 1.0 for run in (one, held)]
    assert moved[1] == pytest.approx(1e-2, rel=1e-6)
    assert abs(moved[0]) < 0.9e-2


def test_nothing_is_held_of_a_fuzzy_curve():
    fuzzy = OBSERVER | {'variant': 'fuzzy_adaptive'}
    runs = [simulate(fuzzy, PLANT, solver, 1e-3, duration=0.2) for solver in ('ode4', 'ode4 held')]
    for one, held in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, held)


def test_every_thins_the_record_and_nothing_else():
    whole = simulate(OBSERVER, PLANT, 'ode3', 1e-3, duration=1.0)
    thin = simulate(OBSERVER, PLANT, 'ode3', 1e-3, duration=1.0, every=10)
    for a, b in zip(whole, thin, strict=True):
        np.testing.assert_allclose(a[::10], b, rtol=1e-14)


def test_a_model_that_differs_from_the_plant_is_the_observers_own():
    """The paper's first observer knows no Phi_3: its theta estimates eta = -z3 + d."""
    observer = OBSERVER | {'variant': 'fuzzy', 'unknown_input': False, 'phi': ['0', '0', '0']}
    observer |= {'initial_estimate': 0.2, 'initial_internal': 0.2, 'fuzzy_widths': [0.01]}
    run = simulate(observer, PLANT, 'ode4', 1e-3, duration=10.0)
    eta = run.unknown_input - run.z[:, 2]
    late = run.t > 5.0
    error = run.z_tilde[late, 2] - eta[late]
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(eta[late] ** 2))
