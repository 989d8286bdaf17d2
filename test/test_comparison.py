# SPDX-License-Identifier: Apache-2.0
"""The studies of other observers: peers are what they say."""

from fhaosmo_ros.core import Recording, TriangularModel
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from studies.methods import estimates, SampledModel

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
    # At rest the first step of y moves the estimates by the gain.
    rest = np.zeros(2)
    step = Recording(np.array([0.0, period]), np.array([0.0, 1.0]), rest, rest, rest, 'steps')
    found = estimates(model, gain, decay, step, 1.0)
    np.testing.assert_allclose(found[1], gain, rtol=1e-12)
