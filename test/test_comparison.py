# SPDX-License-Identifier: Apache-2.0
"""The studies of other observers: peers are what they say."""

from fhaosmo_ros.core import TriangularModel
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from studies import everywhere
from studies.methods import HUBER, IMM, LINEAR_LIMIT, SampledModel

MODELS = {
    'paper': TriangularModel(['0', '0', '-z3']),
    'pendulum': TriangularModel(['0', '-19.62*sin(z1) - 0.3*z2 - 0.5*tanh(z2/0.1)']),
    'motor': TriangularModel(['0', '500*u - 25*z2']),
}


@pytest.mark.parametrize(('chain', 'decay'), [(1, 0.0), (2, 0.0), (1, 0.7)])
@pytest.mark.parametrize('name', MODELS)
def test_kalman_gain_solves_the_riccati_equation(name, chain, decay):
    model, period, n = MODELS[name], 1e-2, MODELS[name].order
    gain = SampledModel(model, period, chain, decay).kalman(5.0)
    a = np.diag(np.ones(n + chain - 1), 1)  # the linearised, extended model, written down anew
    a[:n, :n] += model.jacobian(np.zeros(n))
    a[-1, -1] = -decay
    spectrum = np.diag([*[0.0] * (len(a) - 1), 5.0])
    middles = (np.arange(200) + 0.5) * period / 200  # the noise's covariance by the midpoint rule
    noise = sum(expm(a * s) @ spectrum @ expm(a * s).T for s in middles) * period / 200
    p = solve_discrete_are(expm(a * period).T, np.eye(len(a))[:, :1], noise, np.eye(1))
    np.testing.assert_allclose(gain, p[:, 0] / (p[0, 0] + 1.0), rtol=1e-4)


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
