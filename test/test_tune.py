# SPDX-License-Identifier: Apache-2.0
"""The command `tune` on simulated recordings: its start, its output, its inputs, its ends."""

from contextlib import closing, suppress
from itertools import product
import math
import signal
import sqlite3
import subprocess
import sys

from commands import ROOT, start, wait_until
from fhaosmo_ros.core import ConfigurationError, Family, Observer, TriangularModel
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import FAMILY_PARAMETERS
from fhaosmo_ros.tools.tuning.command import main, read_parameters
from fhaosmo_ros.tools.tuning.linear_gains import SCHEME
from fhaosmo_ros.tools.tuning.search import BAD, Dimension, minimise
from fhaosmo_ros.tools.tuning.tuner import Objective, simulated, stamps_of, TUNE_PARAMETERS, Tuner
import numpy as np
import pytest
from studies.methods import METHODS, Setting

pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
pytest.importorskip('cmaes', reason='cmaes is not installed (extra: tune)')


PHI = ['0', '0', '-z3']
SHORT = {'duration': 4.0, 'integration_step': 1e-3, 'sample_rate': 200.0, 'noise_std': 1e-4}
GIVEN = SHORT | {'settled': 1.0, 'recordings': 2, 'held_out': 3}
VALUES = TUNE_PARAMETERS.complete(GIVEN)
QUICK = [*(f'-p{name}:={value}' for name, value in GIVEN.items()), '--trials=30', '--jobs=2']


def row(report, name):
    """Return the cells of a row of the table of errors."""
    return next(line for line in report.splitlines() if line.startswith(f'| {name}')).split('|')


def online(values, r):
    """Return what the node's estimator makes of a recording."""
    estimator = OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    return estimator.run(stamps_of(r.t), r.y, r.u)


@pytest.mark.parametrize('weights', [[1.0], [0.0, 1.0, 0.0, 3.0]])
def test_errors_are_those_of_the_nodes_estimator(weights):
    """The objective is a geometric mean of weighted errors, by default of d alone."""
    recordings = Family(SHORT | {'noise_std': 1e-3, 'dropout': 0.05}).recordings(3)
    objective = Objective(recordings, VALUES.changed({'weights': weights}))
    gains = {'lambda': [3.0, 2.0, 2.0, 0.5], 'alpha': [2.0, 1.0, 2.0, 1.5], 'epsilon': 40.0}
    error, found = objective(gains)
    for r, errors in zip(recordings, found, strict=True):
        e, late = online(gains, r), r.t - r.t[0] >= 1.0
        expected = [rms((e.z - r.z)[late, i]) for i in range(3)]
        expected.append(rms((e.unknown_input - r.d)[late]))
        np.testing.assert_allclose(errors, expected, rtol=1e-5)
    truth = np.concatenate([r.d[r.t - r.t[0] >= 1.0] for r in recordings])
    assert objective.scale[-1] == pytest.approx(rms(truth))
    w = np.array(weights) if weights[1:] else np.array([0.0, 0.0, 0.0, 1.0])
    each = np.sqrt((found / objective.scale) ** 2 @ w / w.sum())
    assert error == pytest.approx(np.exp(np.mean(np.log(each))))


def test_infinite_estimate_is_the_worst_and_another_model_is_refused():
    wild = {'lambda': 1e6, 'alpha': 1e9, 'fuzzy_widths': 1e-12, 'epsilon': 1e12}
    objective = Objective(Family(SHORT).recordings(1), VALUES)
    assert objective(wild | {'scheme': 'explicit'})[0] > 1e3
    with pytest.raises(ConfigurationError, match=r"'order': expected 3, .*got 2"):
        objective({'order': 2, 'phi': ['0', '0']})


def test_start_is_nearly_as_good_as_the_best_kalman_filter():
    """Of filters of d as a random walk, over two decades of bandwidths."""
    values = VALUES.changed({'duration': 6.0, 'settled': 2.0, 'recordings': 3})
    tuner = Tuner(simulated(values, 1)[0], {}, values, 1)
    best, setting = np.inf, Setting(TriangularModel(PHI, 3), 1.0 / 200.0, 0.07, 1e-4)
    for bandwidth in np.geomspace(2.0, 200.0, 25):
        run = METHODS['Kalman'].prepare(setting, {'bandwidth': bandwidth})
        recordings = tuner.objective.recordings
        errors = [rms((run(r)[:, 3] - r.d)[r.t >= 2.0]) for r in recordings]
        best = min(best, np.exp(np.mean(np.log(errors))) / tuner.objective.scale[-1])
    start = {d.name: d.start for d in tuner.space}
    assert tuner.objective(tuner.parameters(start))[0] < 1.03 * best
    # Held-out recordings have other seeds.
    pairs = product(*simulated(values, 1))
    assert not any(np.array_equal(a.y, b.y) or np.array_equal(a.d, b.d) for a, b in pairs)


@pytest.mark.parametrize('given', [
    {'structure': 'levant', 'variant': 'fuzzy', 'max_gap': 2.0},
    {'unknown_input_derivatives': 1, 'gamma_min': 0.01, 'correction_period': 0.002},
    {'unknown_input_decay': 2.0, 'noise_size': 2e-4, 'fuzzy_widths': [0.1]},
    # Another scheme begins with its own gains.
    {'scheme': 'implicit', 'unknown_input': False},
    {'lambda': [1.0], 'alpha': [2.0]},
])  # fmt: skip
def test_what_the_user_sets_stays(given):
    tuner = Tuner(simulated(VALUES, 1)[0], given, VALUES, 1)
    found = tuner.parameters({d.name: d.start for d in tuner.space})
    if tuner.space[0].name == 'lambda[0]':
        expected = Observer(given).parameters
        assert tuner.space[0].start == expected['lambda'][0]
        assert all(found[k] == expected[k] for k in ('scheme', 'variant', 'unknown_input'))
    else:
        assert (dict(SCHEME) | given).items() <= found.items()
        assert len(found['lambda']) == 4 + found['unknown_input_derivatives']
        assert {d.name for d in tuner.space}.isdisjoint(given)


@pytest.mark.parametrize('arguments', [
    QUICK, [*QUICK, '-pstructure:=levant', '-pscheme:=implicit'],
])  # fmt: skip
def test_estimator_loads_the_output_and_the_next_tuning_begins_there(arguments, tmp_path, capsys):
    first, out = tmp_path / 'first', tmp_path / 'out'
    assert main([*arguments, '-o', str(first)]) == 0
    assert sorted(path.name for path in first.iterdir()) == ['gains.yaml', 'report.md']
    text = (first / 'gains.yaml').read_text()
    assert f'python -m fhaosmo_ros tune {" ".join(arguments)}' in text
    values = load(first / 'gains.yaml', 'estimator')
    if arguments == QUICK:
        assert (dict(SCHEME) | {'correction_period': 0.005}).items() <= values.items()
    else:
        assert values['epsilon'] == max(values['fuzzy_widths'])
    report = (first / 'report.md').read_text()
    head = '| start, training | start, held out | tuned, training | tuned, held out |'
    assert head in report
    assert head in capsys.readouterr().out
    # What the report says of the gains is what these very gains do.
    judged = Objective(Family(SHORT).recordings(2, 1), VALUES)(values)[0]
    assert f'{judged:.4f}' == row(report, 'error, relative')[4].strip()
    more = ['--trials=3', f'--params-file={first}/gains.yaml', f'-o{out}', '-pnoise_std:=0']
    assert main([*arguments, *more]) == 0
    assert 'gains are for a y without noise' not in report
    report = (out / 'report.md').read_text()
    assert 'gains are for a y without noise' in report
    before, _, tuned, _ = map(float, row(report, 'error, relative')[2:6])
    assert tuned <= before
    assert values.keys() == load(out / 'gains.yaml', 'estimator').keys()


@pytest.mark.parametrize(('section', 'model'), [
    *((name, "order: 1, phi: ['-2.0*z1']") for name in ('/**', 'estimator', 'plant', 'tune')),
    ('estimator', "channels: [hip], hip: {order: 1, phi: ['-2.0*z1'], gains: self_tuning}"),
])  # fmt: skip
def test_model_may_stand_in_any_section_or_be_a_channels(tmp_path, section, model):
    path = tmp_path / 'model.yaml'
    path.write_text(f'{section}: {{ros__parameters: {{{model}}}}}\n')
    estimator, tuning = read_parameters([path], ['noise_std:=0.1', 'gains:=self_tuning'])
    assert tuning['noise_std'] == 0.1
    values = VALUES.changed(tuning)
    tuner = Tuner(simulated(values, 1)[0], estimator, values, 1)
    assert tuner.parameters({}).items() >= {'phi': ['-2.0*z1'], 'gains': 'fixed'}.items()


@pytest.mark.signals
def test_interrupt_keeps_the_best_and_the_next_run_goes_on(tmp_path):
    out, storage = tmp_path / 'out', tmp_path / 'study.db'

    def finished():
        with closing(sqlite3.connect(storage)) as base, suppress(sqlite3.OperationalError):
            (row,) = base.execute("SELECT count(*) FROM trials WHERE state='COMPLETE'")
            return row[0]
        return 0  # its tables are made right now

    command = [*QUICK, '-pscheme:=explicit', '--jobs=1', '--force', f'-o{out}']
    command.append(f'--storage=sqlite:///{storage}')
    with start('tune', *command, '--trials=1000000', stdout=subprocess.DEVNULL) as process:
        try:
            wait_until(lambda: finished() > 3, 'trial', process=process)
            process.send_signal(signal.SIGINT)
            assert process.wait(300.0) == 0
        finally:
            process.kill()
    load(out / 'gains.yaml', 'estimator')
    trials = finished() + 2
    assert main([*command, f'--trials={trials}']) == 0
    assert f'# {trials} trials' in (out / 'gains.yaml').read_text()
    assert finished() == trials


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
    objective = Objective(family.recordings(3, seed=77), TUNE_PARAMETERS.defaults())
    demo = load(ROOT / 'config' / 'demo.yaml', 'estimator')
    assert objective(values)[0] < min(0.95, 0.9 * objective(demo)[0])


SPACE = [Dimension('a', 1e-3, 1e3, 1.0), Dimension('b', -5.0, 5.0, 0.0, log=False)]


def bowl(values):
    return math.log10(values['a'] / 30.0) ** 2 + (values['b'] - 2.0) ** 2


def test_minimum_is_found_from_the_start_on_as_the_seed_says():
    seen = []
    study = minimise(lambda v: bowl(seen.append(v) or v), SPACE, trials=250, seed=3)
    assert seen[0] == {'a': 1.0, 'b': 0.0}
    assert len(seen) == len(study.trials) == 250
    assert study.best_value == bowl(study.best_params) == min(map(bowl, seen)) < 1e-2
    values = [minimise(bowl, SPACE, 250, seed).best_value for seed in (3, 4)]
    assert [value == study.best_value for value in values] == [True, False]


def test_values_that_are_not_finite_are_bad_and_a_missing_package_is_named(monkeypatch):
    assert minimise(lambda v: float('nan'), SPACE, 5).best_value == BAD
    monkeypatch.setitem(sys.modules, 'optuna', None)
    with pytest.raises(ConfigurationError, match=r"pip install 'optuna>=4,<6' cmaes"):
        minimise(bowl, SPACE, 1)
