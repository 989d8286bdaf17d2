# SPDX-License-Identifier: Apache-2.0
"""Where `tune` begins: gains that make the observer a Kalman filter, and who gets them."""

from pathlib import Path

import pytest

pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
pytest.importorskip('cmaes', reason='cmaes is not installed (extra: tune)')
from fhaosmo_ros.core import Family, Observer, TriangularModel
from fhaosmo_ros.core.observer.fuzzy import curves
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.recording_parameters import FAMILY_PARAMETERS
from fhaosmo_ros.tools.tuning.command import main
from fhaosmo_ros.tools.tuning.linear_gains import least_damping, with_gain
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.source import simulated
from fhaosmo_ros.tools.tuning.space import changes
from fhaosmo_ros.tools.tuning.start import KalmanStart, SCHEME, with_scheme
from fhaosmo_ros.tools.tuning.tuner import Tuner
import numpy as np
from studies.comparison.methods.linear import estimates
from studies.comparison.methods.sampled import SampledModel

ROOT = Path(__file__).resolve().parents[1]
PHI = ['0', '0', '-z3']
SHORT = {'duration': 6.0, 'integration_step': 1e-3, 'sample_rate': 200.0, 'noise_std': 1e-4}
VALUES = TUNE_PARAMETERS.complete(SHORT | {'settled': 2.0, 'recordings': 3, 'held_out': 3})
QUICK = [f'-p{name}:={value}' for name, value in SHORT.items()] + [
    '-psettled:=2.0',
    '-precordings:=3',
    '-pheld_out:=3',
    '--trials=6',
    '--jobs=2',
]


# the Kalman filter inside (D 19)


@pytest.mark.parametrize(('derivatives', 'decay'), [(0, 0.0), (0, 0.7), (1, 1.0), (2, 3.0)])
def test_kalman_like_gains_make_a_kalman_filter(derivatives, decay):
    """The wider the half-widths and the smaller gamma, the closer."""
    period, bandwidth, noise = 1e-3, 15.0, 1e-3
    r = Family({'duration': 5.0, 'integration_step': 1e-3, 'noise_std': noise}).recording(0)
    model = SampledModel(TriangularModel(PHI, 3), period, 1 + derivatives, decay=decay)
    gain = model.kalman([period * bandwidth ** (2 * model.size)])
    expected = estimates(TriangularModel(PHI, 3), gain, decay, r, 0.1)
    apart = []
    psi = curves(OBSERVER_PARAMETERS.defaults(), model.size)
    for width, gamma in ((10.0, 1e-2), (1e3, 1e-4)):
        observer = Observer(
            dict(SCHEME)
            | {
                'unknown_input_derivatives': derivatives,
                'unknown_input_decay': decay,
                'lambda': with_gain(gain, period, width, psi, noise, gamma).tolist(),
                'fuzzy_widths': [width],
                'gamma_initial': gamma,
                'gamma_min': 1e-5,
                'correction_period': period,
            }
        )
        found = observer.run(r.t, r.y, r.u).z_hat
        error = np.sqrt(np.mean((found - expected) ** 2, axis=0))
        apart.append(np.max(error / np.sqrt(np.mean(expected**2, axis=0))))
    assert apart[0] < 5e-2
    assert apart[1] < 1e-3
    assert apart[1] < 0.1 * apart[0]


def test_bandwidth_is_that_of_the_matern_process_of_d():
    """Were d and the noise c times as large, the filter would be the same one."""
    recordings = Family(SHORT).recordings(2)
    large = [r._replace(y=9.0 * r.y, z=9.0 * r.z, d=9.0 * r.d) for r in recordings]
    p = OBSERVER_PARAMETERS.complete({'order': 3, 'phi': PHI})
    for k in (0, 2):
        one, other = (KalmanStart(rs, {}, p, k, 1e-4) for rs in (recordings, large))
        assert one.bandwidth(2.0) == pytest.approx(other.bandwidth(2.0))
        assert one.bandwidth(4.0) > one.bandwidth(2.0)
        widths = [start(0.5, 1.25)['fuzzy_widths'][0] for start in (one, other)]
        assert widths[1] == pytest.approx(9.0 * widths[0])
    # k = 0: a first-order Gauss-Markov process, var = intensity / (2 rate).
    start = KalmanStart(recordings, {}, p, 0, 1e-4)
    d = np.concatenate([r.d for r in recordings])
    noise = np.concatenate([r.y - r.z[:, 0] for r in recordings])
    expected = (np.mean(d**2) * 2.0 * 3.0 / (np.mean(noise**2) / 200.0)) ** (1 / 8)
    assert start.bandwidth(3.0) == pytest.approx(expected)


# the start


@pytest.fixture(scope='module', name='tuner')
def _tuner():
    return Tuner(simulated(VALUES, 1), {}, VALUES, 1, jobs=2)


def test_start_is_as_good_as_the_best_kalman_filter(tuner):
    """Of filters of d as a random walk, over two decades of bandwidths."""
    best = np.inf
    settled = VALUES['settled']
    for bandwidth in np.geomspace(2.0, 200.0, 25):
        model = SampledModel(TriangularModel(PHI, 3), 1.0 / 200.0)
        gain = model.kalman([model.period * bandwidth**8])
        errors = []
        for r in tuner.data.training:
            wrong = estimates(TriangularModel(PHI, 3), gain, 0.0, r, 0.1)[:, 3] - r.d
            errors.append(np.sqrt(np.mean(wrong[r.t >= settled] ** 2)) / tuner.training.scale[-1])
        best = min(best, float(np.exp(np.mean(np.log(errors)))))
    assert tuner.training(tuner.before).error < 1.01 * best
    assert set(tuner.tried) == {0, 1, 2, 3}
    chosen = tuner.fixed['unknown_input_derivatives']
    assert 0.99 * tuner.tried[chosen] <= min(tuner.tried.values())
    assert tuner.training(tuner.before).objective == pytest.approx(tuner.tried[chosen])


# who gets it


@pytest.mark.parametrize(
    ('given', 'scheme'),
    [
        ({}, 'predict_correct'),
        ({'structure': 'levant'}, 'predict_correct'),
        ({'scheme': 'predict_correct'}, 'predict_correct'),
        ({'variant': 'fuzzy', 'max_gap': 2.0}, 'predict_correct'),
        ({'structure': 'cascade'}, None),
        ({'scheme': 'implicit'}, 'implicit'),
        ({'structure': 'levant', 'scheme': 'implicit'}, 'implicit'),
        ({'unknown_input': False}, None),
        ({'lambda': [1.0], 'alpha': [2.0]}, None),
    ],
)
def test_what_the_user_sets_stays(given, scheme):
    recordings = Family(SHORT).recordings(1)
    found = with_scheme(given, recordings)
    assert given.items() <= found.items()
    assert found.get('scheme') == scheme
    if scheme == 'predict_correct':
        assert found['structure'] == 'levant'
        assert found['correction_period'] == 0.005
    else:
        assert found == given
    Observer(ESTIMATOR_PARAMETERS.complete(found))


def test_own_values_win_over_theory():
    own = {
        'unknown_input_derivatives': 1,
        'gamma_min': 0.01,
        'correction_period': 0.002,
        'unknown_input_decay': 2.0,
    }
    values = VALUES.changed({'search': ['lambda', 'gamma_initial'], 'recordings': 1})
    tuner = Tuner(simulated(values, 1), own, values, 1)
    assert own.items() <= tuner.fixed.items()
    assert set(tuner.tried) == {1}
    # What goes with the gains and is not searched is written, too.
    assert len(tuner.fixed['fuzzy_widths']) == 5
    assert tuner.before['gamma_initial'] == 0.01


def test_yaml_is_what_the_estimator_runs(tmp_path, capsys):
    out = tmp_path / 'out'
    assert main([*QUICK, '-o', str(out)]) == 0
    values = load(out / 'gains.yaml', 'estimator')
    given = dict(SCHEME) | {'correction_period': 0.005}
    assert given.items() <= values.items()
    n = 4 + values['unknown_input_derivatives']
    assert len(values['lambda']) == len(values['fuzzy_widths']) == n
    assert 'derivatives' in (out / 'report.md').read_text()
    assert 'alpha' not in values
    online = OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    r = Family(SHORT | {'duration': 12.0}).recording(5)
    stamps = np.round(r.t * 1e9).astype(np.int64) + 10**9
    found = online.run(stamps, r.y, r.u)
    late = r.t > 4.0
    error = np.sqrt(np.mean((found.unknown_input - r.d)[late] ** 2) / np.mean(r.d[late] ** 2))
    assert error < 0.9
    # The next tuning begins there.
    again = tmp_path / 'again'
    file = ['--params-file', str(out / 'gains.yaml')]
    assert main([*QUICK, '--trials=1', *file, '-o', str(again)]) == 0
    assert 'given, training' in capsys.readouterr().out
    assert load(again / 'gains.yaml', 'estimator').keys() == values.keys()


# what is shipped


# damping of the errors


@pytest.mark.parametrize('levels', [2, 3, 4])
def test_damping_of_a_chain_of_integrators_is_butterworths(levels):
    period, width, noise = 1e-3, 1e3, 1e-3
    model = SampledModel(TriangularModel(['0'], 1), period, levels - 1)
    psi = curves(OBSERVER_PARAMETERS.defaults(), levels)
    k = model.kalman([period * 15.0 ** (2 * levels)])
    gains = with_gain(k, period, width, psi, noise, 1e-4)
    values = dict(SCHEME) | {
        'order': 1, 'phi': ['0'], 'unknown_input_derivatives': levels - 2,
        'correction_period': period, 'noise_size': noise, 'lambda': gains.tolist(),
        'fuzzy_widths': [width], 'gamma_initial': 1e-4,
    }  # fmt: skip
    expected = np.sin(np.pi / (2.0 * levels))
    assert least_damping(Observer(values)) == pytest.approx(expected, rel=0.03)


def test_search_avoids_gains_whose_errors_grow(tuner):
    start = {d.name: d.start for d in tuner.space}
    before = tuner.training(changes(start)).objective
    assert tuner.evaluate(start) == before
    last = max(name for name in start if name.startswith('lambda'))
    worse = start | {last: 100.0 * start[last]}
    assert tuner.evaluate(worse) > 1.5 * tuner.training(changes(worse)).objective


@pytest.mark.parametrize('path', sorted((ROOT / 'config').glob('**/*.yaml')), ids=lambda p: p.stem)
def test_errors_with_shipped_gains_are_damped(path):
    assert least_damping(Observer(load(path, 'estimator', OBSERVER_PARAMETERS))) > 0.05


@pytest.mark.parametrize('name', ['paper_plant', 'pendulum', 'dc_motor'])
def test_gains_of_the_models_follow_their_plant(name):
    path = ROOT / 'config' / 'models' / f'{name}.yaml'
    assert 'python -m fhaosmo_ros tune ' in path.read_text()
    values = load(path, 'estimator')
    plant = load(path, 'plant')
    amplitude = plant['disturbance_amplitude']
    shared = load(path, 'plant', FAMILY_PARAMETERS)
    family = Family(shared | {'rms_of_d': 0.7 * amplitude, 'integration_step': 1e-3})
    r = family.recording(0, seed=78)
    online = OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    found = online.run(np.round(r.t * 1e9).astype(np.int64) + 1, r.y, r.u)
    error = np.sqrt(np.mean((found.unknown_input - r.d)[r.t >= 5.0] ** 2))
    assert error < 0.3 * amplitude


def test_gains_that_are_written_are_as_good_as_those_that_were_judged_without_noise():
    """Written are also rules for when y is lost, which half-widths have to leave room for."""
    quiet = {'noise_std': 0.0, 'sample_rate': 1000.0, 'disturbances': ['sines']}
    values = VALUES.changed(quiet)
    tuner = Tuner(simulated(values, 1), {}, values, 1, jobs=2)
    judged = tuner.training(tuner.before).error
    assert judged < 0.1
    assert tuner.training(tuner.parameters(tuner.before)).error < 1.01 * judged


def test_bounds_are_near_a_start_by_kalman_and_far_from_others(tuner):
    def decades(some, name):
        return next(np.log10(d.high / d.low) for d in some.space if d.name == name)

    cascade = Tuner(tuner.data, {'scheme': 'implicit'}, VALUES, 1)
    assert not cascade.tried
    for name in ('lambda[0]', 'fuzzy_widths[1]'):
        assert 0.0 < decades(tuner, name) < decades(cascade, name) == pytest.approx(6.0)
    wide = Tuner(tuner.data, {'unknown_input_derivatives': 0}, VALUES.changed({'decades': 4.0}), 1)
    assert decades(wide, 'lambda[0]') == pytest.approx(8.0)


@pytest.mark.parametrize('noise', ['1e-4', '1e-3', '1e-2'])
def test_presets_fit_the_noise_in_their_name(noise):
    path = ROOT / 'config' / f'noise_{noise}.yaml'
    text = path.read_text()
    assert 'python -m fhaosmo_ros tune ' in text
    assert f'-p noise_std:={noise} -o noise_{noise}\n' in text
    values = load(path, 'estimator')
    assert dict(SCHEME).items() <= values.items()
    assert load(path, 'plant')['noise_std'] == float(noise)
    family = Family({'noise_std': float(noise), 'integration_step': 1e-3})
    recordings = family.recordings(3, seed=77)
    tuning = TUNE_PARAMETERS.defaults()
    demo = load(ROOT / 'config' / 'demo.yaml', 'estimator')
    judged = []
    for p in (values, demo):
        complete = ESTIMATOR_PARAMETERS.complete(p)
        judged.append(Objective(recordings, complete, tuning, choose=False)({}))
    assert judged[0].error < min(0.95, 0.9 * judged[1].error)
    # The node's own path gives the same.
    r = recordings[0]
    online = OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    found = online.run(np.round(r.t * 1e9).astype(np.int64) + 1, r.y, r.u)
    late = r.t >= tuning['settled']
    error = np.sqrt(np.mean((found.unknown_input - r.d)[late] ** 2))
    assert error == pytest.approx(judged[0].scores.error[0, 0, -1], rel=1e-3)
