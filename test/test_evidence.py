# SPDX-License-Identifier: Apache-2.0
"""docs/evidence.md says what its tables say; new simulations and the paper's findings agree."""

from fhaosmo_ros.core import Recording, TriangularModel
import numpy as np
import pytest
import results
from scipy.linalg import expm, solve_discrete_are
from studies import comparison, everywhere, evidence, paper
from studies.methods import estimates, SampledModel

MAKERS = {
    'speed': results, 'comparison': comparison, 'everywhere': everywhere, 'paper': paper,
}  # fmt: skip


@pytest.mark.parametrize('name', MAKERS)
def test_the_page_says_what_the_table_says(name):
    shown = evidence.parts((evidence.DOCS / evidence.PAGE).read_text(encoding='utf-8'))
    texts = MAKERS[name].texts(evidence.read(name))
    assert {part: shown[part] for part in texts} == texts


@pytest.fixture(scope='module')
def documented():
    rows = evidence.read('paper')
    return {solver: paper.scores_of(rows, solver) for solver in (paper.SOLVER, *paper.EARLIER)}


@pytest.mark.parametrize('name', [name for name, c in paper.OBSERVERS.items() if c.step == 1e-3])
@pytest.mark.parametrize('omega', paper.FREQUENCIES)
def test_new_simulation_of_the_paper_agrees_with_the_table(documented, name, omega):
    # Trajectories with sign depend on the last bit, so on the machine.
    tolerance = np.log(1.5 if name.startswith('sign') else 1.05)
    old, new = documented[paper.SOLVER][name, omega], paper.score(paper.simulated(name, omega))
    for key in ('rms_z1', 'rms_z2', 'rms_z3', 'rms_d'):
        if max(new[key], old[key]) > 1e-12:  # 0 but for rounding while it slides
            assert abs(np.log(new[key] / old[key])) < tolerance, f'{key}: run make paper'


def test_best_solver_and_all_findings_come_out(documented):
    def error(solver):
        return sum(documented[solver][paper.FINE, w]['rms_d'] for w in paper.FREQUENCIES)

    *_, held = paper.EARLIER
    assert min(set(documented) - {held}, key=error) == paper.SOLVER
    assert all(v.holds for v in paper.verdicts(documented[paper.SOLVER]))


# The Kalman filter beside which the others are shown is one

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
