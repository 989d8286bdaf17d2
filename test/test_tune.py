# SPDX-License-Identifier: Apache-2.0
"""The command `tune` on simulated recordings: its start, its output, its inputs, its ends."""

from contextlib import closing
from pathlib import Path
import re
import signal
import sqlite3
import subprocess

from commands import start
from fhaosmo_ros.core import ConfigurationError, Family, Observer, TriangularModel
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import FAMILY_PARAMETERS
from fhaosmo_ros.tools.tuning import report
from fhaosmo_ros.tools.tuning.command import main, read_parameters
from fhaosmo_ros.tools.tuning.linear_gains import kalman_gains, SCHEME
from fhaosmo_ros.tools.tuning.objective import Objective, stamps_of, TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.tuner import simulated, Tuner
import numpy as np
import pytest
from studies.methods import estimates, SampledModel
from waiting import wait_until

pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
pytest.importorskip('cmaes', reason='cmaes is not installed (extra: tune)')


ROOT = Path(__file__).resolve().parents[1]
PHI = ['0', '0', '-z3']
SHORT = {'duration': 4.0, 'integration_step': 1e-3, 'sample_rate': 200.0, 'noise_std': 1e-4}
VALUES = TUNE_PARAMETERS.complete(SHORT | {'settled': 1.0, 'recordings': 2, 'held_out': 3})
QUICK = [f'-p{name}:={value}' for name, value in SHORT.items()] + [
    '-psettled:=1.0', '-precordings:=2', '-pheld_out:=3', '--trials=12', '--jobs=2',
]  # fmt: skip
EXPLICIT = [*QUICK, '-pscheme:=explicit']
FILES = ['gains.yaml', 'report.md']
MODEL_OF_D = ['unknown_input_size:=1.0', 'unknown_input_decay:=1.0']
GAINS = {'lambda': [3.0, 2.0, 2.0, 0.5], 'alpha': [2.0, 1.0, 2.0, 1.5], 'epsilon': 40.0,
         'fuzzy_widths': [0.11, 0.05, 0.59, 0.34]}  # fmt: skip


def row(report_, name):
    """Return the cells of a row of the table of errors."""
    return next(line for line in report_.splitlines() if line.startswith(f'| {name}')).split('|')


def online(values, r):
    """Return what the node's estimator makes of a recording."""
    estimator = OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    return estimator.run(stamps_of(r.t), r.y, r.u)


# the objective


@pytest.mark.parametrize(('scheme', 'unknown_input'), [('implicit', True), ('explicit', False)])
def test_errors_are_those_of_the_nodes_estimator(scheme, unknown_input):
    family = Family(SHORT | {'noise_std': 1e-3, 'dropout': 0.05})
    recordings, n = family.recordings(3), 3 + unknown_input
    fixed = {'scheme': scheme, 'unknown_input': unknown_input}
    gains = {k: v if k == 'epsilon' else v[:n] for k, v in GAINS.items()}
    objective = Objective(recordings, VALUES)
    found = objective(fixed | gains)
    for r, errors in zip(recordings, found.errors, strict=True):
        e, late = online(fixed | gains, r), r.t - r.t[0] >= 1.0
        expected = [rms((e.z - r.z)[late, i]) for i in range(3)]
        expected.append(rms((e.unknown_input - r.d)[late]))
        np.testing.assert_allclose(errors, expected, rtol=1e-5)
    truth = np.concatenate([r.d[r.t - r.t[0] >= 1.0] for r in recordings])
    assert objective.scale[-1] == pytest.approx(rms(truth))
    assert found.error == pytest.approx(np.exp(np.mean(np.log(found.errors[:, -1] / rms(truth)))))


def made_objective(monkeypatch, judged, **changes):
    """Return the evaluation of two recordings that are judged like this."""
    objective = Objective(Family(SHORT).recordings(2), VALUES.changed(changes), np.ones(4))
    results = iter(judged)
    monkeypatch.setattr(objective, '_judge', lambda *_: next(results))
    return objective({})


def test_objective_is_a_geometric_mean_of_weighted_errors(monkeypatch):
    judged = [np.array([1.0, 7.0, 1.0, 4.0]), np.array([1.0, 7.0, 1.0, 1.0])]
    found = made_objective(monkeypatch, judged, weights=[0.0, 1.0, 0.0, 3.0])
    each = np.sqrt([(49.0 + 3.0 * 16.0) / 4.0, (49.0 + 3.0) / 4.0])
    assert found.error == pytest.approx(np.sqrt(each[0] * each[1]))
    assert made_objective(monkeypatch, judged).error == pytest.approx(2.0)  # of d alone


def test_infinite_estimate_is_the_worst_and_another_model_is_refused():
    wild = {'lambda': 1e6, 'alpha': 1e9, 'fuzzy_widths': 1e-12, 'epsilon': 1e12}
    objective = Objective(Family(SHORT).recordings(1), VALUES)
    assert objective(wild | {'scheme': 'explicit'}).error > 1e3
    with pytest.raises(ConfigurationError, match=r"'order': expected 3, .*got 2"):
        objective({'order': 2, 'phi': ['0', '0']})


# the Kalman filter inside (D 19)


@pytest.mark.parametrize(('derivatives', 'decay'), [(0, 0.7), (1, 1.0), (2, 3.0)])
def test_gains_of_a_kalman_filter_make_one(derivatives, decay):
    """The wider the half-widths and the smaller gamma, the closer."""
    period, model = 1e-3, TriangularModel(PHI, 3)
    r = Family({'duration': 5.0, 'integration_step': 1e-3, 'noise_std': 1e-3}).recording(0)
    apart = []
    for width, gamma in ((10.0, 1e-2), (1e3, 1e-4)):
        values = dict(SCHEME) | {
            'order': 3, 'phi': PHI, 'noise_size': 1e-3, 'unknown_input_size': 0.07,
            'unknown_input_derivatives': derivatives,
            'unknown_input_decay': decay, 'fuzzy_widths': [width], 'gamma_initial': gamma,
            'gamma_min': 1e-5, 'correction_period': period,
        }  # fmt: skip
        made = kalman_gains(OBSERVER_PARAMETERS.complete(values), period)
        expected = estimates(model, made.gain, decay, r, 0.1)
        values |= {'lambda': made.lambdas.tolist(), 'noise_size': 0.0}  # steady from the start
        found = Observer(values).run(r.t, r.y, r.u).z_hat
        error = np.sqrt(np.mean((found - expected) ** 2, axis=0))
        apart.append(np.max(error / np.sqrt(np.mean(expected**2, axis=0))))
    assert apart[0] < 5e-2
    assert apart[1] < min(3e-3, 0.1 * apart[0])


# the start


@pytest.fixture(scope='module', name='tuner')
def _tuner():
    values = VALUES.changed({'duration': 6.0, 'settled': 2.0, 'recordings': 3})
    return Tuner(*simulated(values, 1), {}, values, 1)


def test_start_is_nearly_as_good_as_the_best_kalman_filter(tuner):
    """Of filters of d as a random walk, over two decades of bandwidths."""
    best = np.inf
    for bandwidth in np.geomspace(2.0, 200.0, 25):
        model = SampledModel(TriangularModel(PHI, 3), 1.0 / 200.0)
        gain = model.kalman(model.period * bandwidth**8)
        errors = []
        for r in tuner.training.recordings:
            wrong = estimates(TriangularModel(PHI, 3), gain, 0.0, r, 0.1)[:, 3] - r.d
            errors.append(rms(wrong[r.t >= 2.0]) / tuner.training.scale[-1])
        best = min(best, float(np.exp(np.mean(np.log(errors)))))
    start = {d.name: d.start for d in tuner.space}
    assert tuner.training(tuner.parameters(start)).error < 1.03 * best
    assert [*start] == ['unknown_input_size', 'unknown_input_decay']
    # Held-out recordings are others, and errors relative to the same scale.
    assert not any(a is b for a in tuner.training.recordings for b in tuner.held_out.recordings)
    np.testing.assert_array_equal(tuner.held_out.scale, tuner.training.scale)


@pytest.mark.parametrize(
    'given',
    [
        {'structure': 'levant', 'scheme': 'predict_correct'},
        {'variant': 'fuzzy', 'max_gap': 2.0},
        {'unknown_input_derivatives': 1, 'gamma_min': 0.01, 'correction_period': 0.002},
        {'unknown_input_decay': 2.0, 'noise_size': 2e-4, 'fuzzy_widths': [0.1]},
    ],
)
def test_what_the_user_sets_stays_with_gains_of_a_kalman_filter(given):
    tuner = Tuner(*simulated(VALUES, 1), given, VALUES, 1)
    found = tuner.parameters({d.name: d.start for d in tuner.space})
    assert dict(SCHEME).items() <= (found | {k: SCHEME[k] for k in SCHEME if k in given}).items()
    assert given.items() <= found.items()
    assert len(found['lambda']) == 4 + found['unknown_input_derivatives']
    assert {d.name for d in tuner.space}.isdisjoint(given)


@pytest.mark.parametrize(
    'given',
    [
        {'structure': 'cascade'},
        {'scheme': 'implicit', 'unknown_input': False},
        {'structure': 'levant', 'scheme': 'implicit'},
        {'lambda': [1.0], 'alpha': [2.0]},
    ],
)
def test_another_scheme_begins_with_its_own_gains(given):
    tuner = Tuner(*simulated(VALUES, 1), given, VALUES, 1)
    expected = Observer(given).parameters
    assert tuner.space[0].name == 'lambda[0]'
    assert tuner.space[0].start == expected['lambda'][0]
    found = tuner.parameters({d.name: d.start for d in tuner.space})
    assert {
        k: expected[k] for k in ('scheme', 'variant', 'unknown_input')
    }.items() <= found.items()
    assert 'noise_size' not in found


def test_start_without_noise_is_nearly_exact():
    """And nothing is written that would say how sure the observer is."""
    quiet = {'noise_std': 0.0, 'sample_rate': 1000.0, 'disturbances': ['sines'], 'duration': 6.0}
    values = VALUES.changed(quiet | {'settled': 2.0})
    tuner = Tuner(*simulated(values, 1), {}, values, 1)
    start = tuner.parameters({d.name: d.start for d in tuner.space})
    assert tuner.training(start).error < 0.1
    assert {'noise_size', 'unknown_input_size'}.isdisjoint(start)


# output


def test_output_is_what_the_estimator_loads(tmp_path, capsys):
    out = tmp_path / 'out'
    out.mkdir()
    (out / 'mine').touch()
    assert main([*QUICK, '-o', str(out)]) == 2
    assert 'expected a new name (or --force' in capsys.readouterr().err
    assert main([*QUICK, '-o', str(out), '--force']) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert list(tmp_path.iterdir()) == [out]
    values = load(out / 'gains.yaml', 'estimator')
    assert (dict(SCHEME) | {'correction_period': 0.005}).items() <= values.items()
    assert len(values['lambda']) == 4 + values['unknown_input_derivatives']
    OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    text = (out / 'gains.yaml').read_text()
    assert f'python -m fhaosmo_ros tune {" ".join(QUICK)}' in text
    report_ = (out / 'report.md').read_text()
    printed = capsys.readouterr().out
    for word in ('start, training', 'start, held out', 'tuned, training', 'tuned, held out'):
        assert word in report_
        assert word in printed
    # What the report says of the gains is what these very gains do.
    judged = Objective(Family(SHORT).recordings(2, 1), VALUES)(values)
    assert f'{judged.error:.4f}' == row(report_, 'error, relative')[4].strip()


@pytest.mark.parametrize('arguments', [QUICK, EXPLICIT])
def test_next_tuning_begins_where_one_has_ended(tmp_path, arguments):
    first, out = tmp_path / 'first', tmp_path / 'out'
    assert main([*arguments, '--trials=30', '-o', str(first)]) == 0
    given = str(first / 'gains.yaml')
    assert main([*arguments, '--trials=3', '--params-file', given, '-o', str(out)]) == 0
    report_ = (out / 'report.md').read_text()
    assert 'given, training' in report_
    before, _, tuned, _ = map(float, row(report_, 'error, relative')[2:6])
    assert tuned <= before
    values = load(out / 'gains.yaml', 'estimator')
    assert values.keys() == load(first / 'gains.yaml', 'estimator').keys()


@pytest.mark.parametrize('section', ['/**', 'estimator', 'plant', 'tune'])
def test_model_may_stand_in_any_section(tmp_path, section):
    path = tmp_path / 'model.yaml'
    path.write_text(f"{section}:\n  ros__parameters: {{order: 1, phi: ['-2.0*z1']}}\n")
    estimator, tuning = read_parameters(
        [path], ['noise_std:=0.1', 'variant:=sign', 'structure:=levant', 'lambda:=1.0']
    )
    values = TUNE_PARAMETERS.complete(SHORT | {'settled': 1.0, 'recordings': 1} | tuning)
    tuner = Tuner(*simulated(values, 1), estimator, values, 1)
    assert tuner.parameters({})['phi'] == ['-2.0*z1']
    # What levant or the variant does not use is passed over.
    names = ['lambda[0]', 'lambda[1]', 'unknown_input_decay']
    assert [d.name for d in tuner.space] == names
    assert tuner.tuning['noise_std'] == 0.1


def test_levant_is_tuned_without_what_it_does_not_use(tmp_path):
    out = tmp_path / 'out'
    assert main([*QUICK, '-pstructure:=levant', '-pscheme:=implicit', '-o', str(out)]) == 0
    values = load(out / 'gains.yaml', 'estimator')
    assert values['structure'] == 'levant'
    assert 'alpha' not in values
    assert values['epsilon'] == max(values['fuzzy_widths'])
    assert values['divergence_time'] == 0.1  # 20 samples at 200 Hz
    assert len(values['lambda']) == 4


def test_report_warns_of_overfitting():
    assert report.warnings(0.4, 0.49) == []
    assert '1.30 times' in report.warnings(0.4, 0.52)[0]


# ends


def finished(storage):
    """Return how many trials the data base of a study holds."""
    with closing(sqlite3.connect(storage)) as base:
        try:
            return base.execute("SELECT count(*) FROM trials WHERE state='COMPLETE'").fetchone()[0]
        except sqlite3.OperationalError:  # its tables are made right now
            return 0


@pytest.mark.signals
def test_interrupt_keeps_the_best_and_the_next_run_goes_on(tmp_path):
    out, storage = tmp_path / 'out', tmp_path / 'study.db'
    command = [*EXPLICIT, '--jobs=1', f'--storage=sqlite:///{storage}', '--force', f'-o{out}']
    process = start('tune', *command, '--trials=1000000', stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: finished(storage) > 3, 'trial', process=process)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=300.0)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, err
    assert sorted(path.name for path in out.iterdir()) == FILES
    load(out / 'gains.yaml', 'estimator')
    trials = finished(storage) + 2
    assert main([*command, f'--trials={trials}']) == 0
    assert f'# {trials} trials' in (out / 'gains.yaml').read_text()
    assert finished(storage) == trials


# wrong input


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['-pnoise:=1'], "unknown parameter 'noise'"),
        (['-psearch:=[lambda]'], "'search'.*leave it out"),
        (
            [f'-p{p}' for p in ('scheme:=predict_correct', *MODEL_OF_D)],
            'expected one of unknown_input_size, unknown_input_decay to search',
        ),
        (['-pweights:=[1.0, 2.0]'], 'weights.*1 or 4 numbers'),
        (['-psettled:=4.0'], 'more than 4 s'),
        (['--trials=0'], '--trials >= 1'),
        (['--storage', 'nodb://x'], 'storage'),
        (['--bag', 'nothing', '-pscheme:=predict_correct'], 'does not exist'),
        (['--params-file', 'nothing.yaml'], 'nothing.yaml'),
        (['-o', '/proc/no/out'], 'output'),
    ],
)
def test_wrong_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main([*EXPLICIT, '-o', 'out', *arguments]) == 2
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith('tune: error')]
    assert len(lines) == 1
    assert re.search(message, lines[0]), lines[0]
    assert list(tmp_path.iterdir()) == []


# what is shipped


@pytest.mark.parametrize('name', ['paper_plant', 'pendulum', 'dc_motor'])
def test_gains_of_the_models_follow_their_plant(name):
    path = ROOT / 'config' / 'models' / f'{name}.yaml'
    amplitude = load(path, 'plant')['disturbance_amplitude']
    shared = load(path, 'plant', FAMILY_PARAMETERS)
    family = Family(shared | {'rms_of_d': 0.7 * amplitude, 'integration_step': 1e-3})
    r = family.recording(0, seed=78)
    found = online(load(path, 'estimator'), r)
    assert rms((found.unknown_input - r.d)[r.t >= 5.0]) < 0.3 * amplitude


@pytest.mark.parametrize('noise', ['1e-4', '1e-3', '1e-2'])
def test_presets_fit_the_noise_in_their_name(noise):
    path = ROOT / 'config' / f'noise_{noise}.yaml'
    values = load(path, 'estimator')
    assert dict(SCHEME).items() <= values.items()
    assert load(path, 'plant')['noise_std'] == float(noise)
    family = Family({'noise_std': float(noise), 'integration_step': 1e-3})
    recordings = family.recordings(3, seed=77)
    demo = load(ROOT / 'config' / 'demo.yaml', 'estimator')
    error, other = (Objective(recordings, TUNE_PARAMETERS.defaults())(p) for p in (values, demo))
    assert error.error < min(0.95, 0.9 * other.error)
