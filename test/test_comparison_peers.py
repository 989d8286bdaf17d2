# SPDX-License-Identifier: Apache-2.0
"""The linear peers: their gains against independent formulas, their recursion against theory."""

from fhaosmo_ros.core import TriangularModel
from fhaosmo_ros.core.simulation.plant import Plant
from fhaosmo_ros.core.simulation.recordings import Recording
import numpy as np
import pytest
from scipy.linalg import expm
from studies.comparison.evaluation import METHODS
from studies.comparison.methods.adaptive import ADAPTIVE
from studies.comparison.methods.linear import FILTERS, pair, placed
from studies.comparison.methods.method import Setting
from studies.comparison.methods.sampled import SampledModel

MODELS = {
    'paper': TriangularModel(['0', '0', '-z3']),
    'pendulum': TriangularModel(['0', '-19.62*sin(z1) - 0.3*z2 - 0.5*tanh(z2/0.1)']),
    'motor': TriangularModel(['0', '500*u - 25*z2']),
}
PERIODS = (1e-3, 1e-2)


def rates(model, chain=1, decay=0.0):
    """Return the linearised, extended model, written down once more."""
    n = model.order
    a = np.diag(np.ones(n + chain - 1), 1)
    a[:n, :n] += model.jacobian(np.zeros(n))
    a[-1, -1] = -decay
    return a


def error_transition(a, period, gain):
    transition = expm(a * period)
    return transition - np.outer(gain, transition[0])


def recording(model, t, z0, d, u=0.0):
    """Return the exact response of a linear model to constant d and u."""
    n = model.order
    a, b = rates(model), np.zeros(n + 1)
    b[n - 1] = model.evaluate(np.zeros(n), u)[-1]
    extended = np.block([[a, b[:, None]], [np.zeros((1, n + 2))]])
    over = {h: expm(extended * h) for h in set(np.diff(t).round(9))}
    x = [np.array([*z0, d, 1.0])]
    for h in np.diff(t).round(9):
        x.append(over[h] @ x[-1])
    x = np.array(x)
    return Recording(t, x[:, 0], np.full(len(t), u), x[:, :n], x[:, n], 'steps')


@pytest.mark.parametrize('period', PERIODS)
@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('speed', [0.1, 3.0, 100.0])
def test_poles_lie_where_they_were_asked(name, period, speed):
    model = MODELS[name]
    poles = [*pair(speed, 0.6), *pair(2.0 * speed, 1.5)][: model.order + 1]
    if len(poles) == 3:
        poles = [*pair(speed, 0.6), complex(-speed)]
    gain = placed(SampledModel(model, period), poles)
    found = np.linalg.eigvals(error_transition(rates(model), period, gain))
    found = np.log(found.astype(complex)) / period
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(poles), rtol=2e-2)


@pytest.mark.parametrize(('chain', 'decay'), [(1, 0.0), (2, 0.0), (1, 0.7)])
@pytest.mark.parametrize('name', MODELS)
def test_kalman_gain_is_the_limit_of_the_riccati_recursion(name, chain, decay):
    model, period = MODELS[name], 1e-2
    intensities = [5.0, 0.3][:chain]
    gain = SampledModel(model, period, chain, decay=decay).kalman(intensities)
    a = rates(model, chain, decay)
    spectrum = np.diag([0.0] * model.order + intensities[::-1])
    # The noise's covariance by the midpoint rule, and the recursion itself.
    middles = (np.arange(200) + 0.5) * period / 200
    noise = sum(expm(a * s) @ spectrum @ expm(a * s).T for s in middles) * period / 200
    transition, p = expm(a * period), np.eye(len(a))
    for _ in range(5000):
        predicted = transition @ p @ transition.T + noise
        k = predicted[:, 0] / (predicted[0, 0] + 1.0)
        p = predicted - np.outer(k, predicted[0])
    np.testing.assert_allclose(gain, k, rtol=1e-4)


@pytest.mark.parametrize('period', PERIODS)
@pytest.mark.parametrize('name', ['paper', 'motor'])
@pytest.mark.parametrize(
    'peer', [m.name for m in FILTERS if all(word not in m.name for word in ('decaying', 'Matern'))]
)
def test_error_of_each_linear_peer_decays_exactly_to_zero(peer, name, period):
    """Without noise and with constant d the error is the transition's power, so it vanishes."""
    model, method = MODELS[name], METHODS[peer]
    setting = Setting(model, period, 1.0, 0.0)
    values = {d.name: d.start for d in method.space(setting)}
    t = np.arange(0.0, 15.0, period)
    r = recording(model, t, [0.3, -0.2, 0.1][: model.order], 0.8, u=0.02)
    found = method.prepare(setting, values)(r)['filtered']
    assert abs(found.d[0] - 0.8) > 0.5
    assert abs(found.d[-1] - 0.8) < 1e-5
    np.testing.assert_allclose(found.z[-1], r.z[-1], atol=1e-6)


@pytest.mark.parametrize('name', ['ESO', *(m.name for m in ADAPTIVE)])
def test_peers_know_the_input_and_bridge_a_gap(name):
    """A constant d from a noise-free y with a known input."""
    model, method = MODELS['motor'], METHODS[name]
    setting = Setting(model, 1e-2, 1.0, 1e-4)
    t = np.concatenate([np.arange(0.0, 5.0, 1e-2), np.arange(5.3, 8.0, 1e-2)])
    r = recording(model, t, [0.3, -0.2], 0.8, u=0.02)
    values = {d.name: d.start for d in method.space(setting)} | {'decay': 1e-6}
    found = method.prepare(setting, values)(r)['filtered']
    after = t > 4.0
    np.testing.assert_allclose(found.d[after], 0.8, atol=1e-3)
    np.testing.assert_allclose(found.z[after], r.z[after], atol=1e-3)


def test_prediction_equals_the_matrix_exponential():
    model, method = MODELS['motor'], METHODS['ESO']
    setting = Setting(model, 1e-2, 1.0, 0.0)
    r = recording(model, np.arange(0.0, 0.5, 1e-2), [0.0, 4.0], 0.5, u=0.1)
    wrong = r._replace(y=r.y + 0.1)
    gain = placed(SampledModel(model, 1e-2, integrators_only=True), [-9.0] * 3)
    found = method.prepare(setting, {'bandwidth': 9.0})(wrong)['filtered']
    a, b = rates(model), np.array([0.0, 50.0, 0.0])
    extended = expm(np.block([[a, b[:, None]], [np.zeros((1, 4))]]) * 1e-2)
    x = np.array([wrong.y[0], 0.0, 0.0, 1.0])
    for k in range(1, len(r.t)):
        x = extended @ x
        x[:3] += gain * (wrong.y[k] - x[0])
        np.testing.assert_allclose([*found.z[k], found.d[k]], x[:3], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize('period', PERIODS)
@pytest.mark.parametrize('name', MODELS)
def test_prediction_steps_are_short_enough(name, period):
    """Four seconds of motion after a push, against steps of a fiftieth."""
    model = MODELS[name]
    t = np.arange(0.0, 4.0, period)
    longest = min(period, SampledModel(model, period).resolution)
    coarse, fine = (
        Plant({
            'order': model.order, 'phi': list(model.phi), 'initial_state': [0.5] * model.order,
            'disturbance': 'none', 'integration_step': step,
        }).simulate(t, 1.0)
        for step in (longest, longest / 50.0)
    )  # fmt: skip
    assert np.abs(coarse.z - fine.z).max() < 1e-4 * np.abs(fine.z).max()
