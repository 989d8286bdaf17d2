# SPDX-License-Identifier: Apache-2.0
"""The studies of other observers: peers that are what they say, and fairness."""

from fhaosmo_ros.core import TriangularModel
from fhaosmo_ros.core.simulation.recordings import Recording
import numpy as np
import pytest
from scipy.linalg import expm
from studies import everywhere
from studies.comparison import PLANTS, sensors
from studies.methods import (
    ADAPTIVE,
    HUBER,
    IMM,
    LINEAR_LIMIT,
    METHODS,
    SampledModel,
    Setting,
)

MODELS = {
    'paper': TriangularModel(['0', '0', '-z3']),
    'pendulum': TriangularModel(['0', '-19.62*sin(z1) - 0.3*z2 - 0.5*tanh(z2/0.1)']),
    'motor': TriangularModel(['0', '500*u - 25*z2']),
}


def rates(model, chain=1, decay=0.0):
    """Return the linearised, extended model, written down once more."""
    n = model.order
    a = np.diag(np.ones(n + chain - 1), 1)
    a[:n, :n] += model.jacobian(np.zeros(n))
    a[-1, -1] = -decay
    return a


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


@pytest.mark.parametrize(('chain', 'decay'), [(1, 0.0), (2, 0.0), (1, 0.7)])
@pytest.mark.parametrize('name', MODELS)
def test_kalman_gain_is_the_limit_of_the_riccati_recursion(name, chain, decay):
    model, period = MODELS[name], 1e-2
    gain = SampledModel(model, period, chain, decay).kalman(5.0)
    a = rates(model, chain, decay)
    spectrum = np.diag([*[0.0] * (len(a) - 1), 5.0])
    # The noise's covariance by the midpoint rule, and the recursion itself.
    middles = (np.arange(200) + 0.5) * period / 200
    noise = sum(expm(a * s) @ spectrum @ expm(a * s).T for s in middles) * period / 200
    transition, p = expm(a * period), np.eye(len(a))
    for _ in range(5000):
        predicted = transition @ p @ transition.T + noise
        k = predicted[:, 0] / (predicted[0, 0] + 1.0)
        p = predicted - np.outer(k, predicted[0])
    np.testing.assert_allclose(gain, k, rtol=1e-4)


@pytest.mark.parametrize('name', ['Kalman', *(m.name for m in ADAPTIVE)])
def test_peers_know_the_input_and_bridge_a_gap(name):
    """A constant d from a noise-free y with a known input."""
    model, method = MODELS['motor'], METHODS[name]
    setting = Setting(model, 1e-2, 1.0, 1e-4)
    t = np.concatenate([np.arange(0.0, 5.0, 1e-2), np.arange(5.3, 8.0, 1e-2)])
    r = recording(model, t, [0.3, -0.2], 0.8, u=0.02)
    values = {d.name: d.start for d in method.space(setting)} | {'decay': 1e-6}
    [found] = method.prepare(setting, values)(r)
    assert abs(found[0, -1] - 0.8) > 0.5
    after = t > 4.0
    np.testing.assert_allclose(found[after, -1], 0.8, atol=1e-3)
    np.testing.assert_allclose(found[after, :-1], r.z[after], atol=1e-3)


@pytest.mark.parametrize('derivatives', [0, 2])
@pytest.mark.parametrize('rate', [100.0, 1000.0])
def test_peers_without_their_options_are_the_kalman_filter(derivatives, rate):
    """Its covariance converges to the steady one; three equal models are one."""
    motor = everywhere.PLANTS['motor']
    condition = everywhere.CONDITIONS['as tuned']._replace(rate=rate)
    r = everywhere.recording(motor, condition, 'chirp', 10.0)
    setting = everywhere.setting_of(motor, condition)
    member = {'derivatives': derivatives, 'bandwidth': 15.0, 'decay': 4.5}
    values = everywhere.at(member, setting.model.order, rate)
    expected = everywhere.error_of(LINEAR_LIMIT, setting, values, [r])
    for name, options in ((HUBER, {}), (IMM, {'spread': 1.0 + 1e-9, 'stay': 1.0})):
        found = everywhere.error_of(name, setting, values | options, [r])
        assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize('plant', PLANTS)
def test_no_judge_was_seen_in_training(plant):
    [*_, sensor] = [s for s in sensors() if s.plant == plant and s.noise and s.rate == 100.0]
    seen = sensor.training(1)
    assert {r.shape for r in seen} <= {'sines', 'steps'}
    for name in sensor.disturbances:
        [judge] = sensor.held_out(name, 1)
        assert not any(np.allclose(r.d, judge.d) for r in seen if len(r.d) == len(judge.d))
        noise = [np.round(r.y - r.z[:, 0], 12)[:50] for r in (*seen, judge)]
        assert not any(np.array_equal(noise[-1], n) for n in noise[:-1])
