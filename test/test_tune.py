# SPDX-License-Identifier: Apache-2.0
"""The command `tune`: its output, its inputs, its ends; few trials each."""

from contextlib import closing
import os
from pathlib import Path
import re
import signal
import sqlite3
import subprocess
import sys

from fhaosmo_ros.core import ConfigurationError, Family, Observer
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.scoring import Scores
from fhaosmo_ros.tools.bags.types import serialise
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.tuning.command import main, read_parameters
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.sensor import identify
from fhaosmo_ros.tools.tuning.source import simulated
import numpy as np
import pytest
from waiting import wait_until

pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
pytest.importorskip('cmaes', reason='cmaes is not installed (extra: tune)')

from fhaosmo_ros.tools.tuning import report
from fhaosmo_ros.tools.tuning.search import Dimension
from fhaosmo_ros.tools.tuning.tuner import Tuner

ROOT = Path(__file__).resolve().parents[1]
SHORT = {'duration': 4.0, 'integration_step': 1e-3, 'sample_rate': 200.0}
TUNING = TUNE_PARAMETERS.complete(SHORT | {'settled': 1.0})
QUICK = [f'-p{name}:={value}' for name, value in SHORT.items()] + [
    '-psettled:=1.0',
    '-precordings:=2',
    '-pheld_out:=3',
    '-pscheme:=explicit',
    '--trials=12',
    '--jobs=2',
]
FILES = ['estimates.png', 'gains.yaml', 'report.md']


def command(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, '-m', 'fhaosmo_ros', 'tune', *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {'PYTHONPATH': str(ROOT)},
        **options,
    )


# output


def test_output_is_what_the_estimator_loads(tmp_path, capsys):
    out = tmp_path / 'out'
    assert main([*QUICK, '-o', str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert list(tmp_path.iterdir()) == [out]
    values = load(out / 'gains.yaml', 'estimator')
    assert len(values['lambda']) == 4
    assert values['scheme'] == 'explicit'
    OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    text = (out / 'gains.yaml').read_text()
    assert f'python -m fhaosmo_ros tune {" ".join(QUICK)}' in text
    report = (out / 'report.md').read_text()
    printed = capsys.readouterr().out
    for word in ('start, training', 'start, held out', 'tuned, training', 'tuned, held out'):
        assert word in report
        assert word in printed
    # What the report says of the gains is what these very gains do.
    judged = Objective(Family(SHORT).recordings(2, 1), values, TUNING, choose=False)(values)
    row = next(line for line in report.splitlines() if line.startswith('| error, relative'))
    assert f'{judged.error:.4f}' == row.split('|')[4].strip()


def test_existing_output_stays_without_force(tmp_path, capsys):
    out = tmp_path / 'out'
    out.mkdir()
    (out / 'mine').touch()
    assert main([*QUICK, '-o', str(out)]) == 2
    assert 'expected a new name (or --force' in capsys.readouterr().err
    assert (out / 'mine').exists()
    assert main([*QUICK, '-o', str(out), '--force']) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES


def test_given_gains_are_where_it_begins_if_they_are_better(tmp_path):
    first = tmp_path / 'first'
    assert main([*QUICK, '--trials=60', '-o', str(first)]) == 0
    given, out = str(first / 'gains.yaml'), tmp_path / 'out'
    assert main([*QUICK, '--trials=1', '--params-file', given, '-o', str(out)]) == 0
    report = (out / 'report.md').read_text()
    row = next(line for line in report.splitlines() if line.startswith('| objective'))
    before, _, tuned, _ = map(float, row.split('|')[2:6])
    assert 'given, training' in report
    assert tuned <= 1.006 * before  # rounded


def test_sections_of_a_file(tmp_path):
    """One file may hold the plant's, the estimator's and the tuning's parameters."""
    path = tmp_path / 'all.yaml'
    path.write_text("""
/**:
  ros__parameters: {order: 2, phi: ['0', '-0.5*z2'], noise_std: 0.001, disturbance: step}
estimator:
  ros__parameters: {variant: sign, scheme: implicit}
tune:
  ros__parameters: {disturbances: [steps], recordings: 2, held_out: 2, duration: 3.0,
                    settled: 1.0, search: [lambda, alpha]}
""")
    out = tmp_path / 'out'
    assert main(['--params-file', str(path), '--trials=8', '-o', str(out)]) == 0
    values = load(out / 'gains.yaml', 'estimator')
    assert values['phi'] == ['0', '-0.5*z2']
    assert values['variant'] == 'sign'
    assert len(values['alpha']) == 3
    assert 'fuzzy_widths' not in values
    assert 'noise_std: 0.001' in (out / 'report.md').read_text()


@pytest.mark.parametrize('section', ['/**', 'estimator', 'plant', 'tune'])
def test_model_may_stand_in_any_section(tmp_path, section):
    path = tmp_path / 'model.yaml'
    path.write_text(f"{section}:\n  ros__parameters: {{order: 1, phi: ['-2.0*z1']}}\n")
    estimator, tuning = read_parameters([path], ['noise_std:=0.1'])
    short = SHORT | {'settled': 1.0, 'recordings': 1}
    values = TUNE_PARAMETERS.complete(tuning | short)
    tuner = Tuner(simulated(values, 1), estimator, values, 1)
    assert tuner.fixed['phi'] == ['-2.0*z1']
    levels = 2 + tuner.fixed.get('unknown_input_derivatives', 0)
    assert sum(d.name.startswith('lambda') for d in tuner.space) == levels
    assert values['noise_std'] == 0.1


# bags


@pytest.fixture(name='bag')
def _bag(tmp_path):
    r = Family(SHORT | {'duration': 9.0, 'noise_std': 1e-3, 'dropout': 0.02}).recording(0)
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('/y', 'std_msgs/msg/Float64')
        stamps = 10**18 + np.round(r.t * 1e9).astype(np.int64)
        for stamp, y in zip(stamps.tolist(), r.y.tolist(), strict=True):
            bag.write('/y', stamp, serialise('std_msgs/msg/Float64', data=y))
    return tmp_path / 'bag'


def test_bag_says_what_its_y_shows(bag, tmp_path, capsys):
    out = tmp_path / 'out'
    arguments = ['--bag', str(bag), '-o', str(out), '--topic', '/y']
    assert main(arguments) == 0
    files = ['estimates.png', 'gains.yaml', 'report.md']
    assert sorted(path.name for path in out.iterdir()) == files
    values = load(out / 'gains.yaml', 'estimator')
    OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values))
    assert values['noise_size'] == pytest.approx(1e-3, rel=0.1)
    assert values['correction_period'] == pytest.approx(1.0 / 200.0, rel=1e-3)
    assert values['input_topic'] == '/y'
    report, printed = (out / 'report.md').read_text(), capsys.readouterr().out
    for row in ('| noise of y', '| size of d', '| expected error of d', '| innovations,'):
        assert row in report
        assert row in printed
    # What this y has shown stands there, and no default of a simulated family.
    assert f'noise_size: {values["noise_size"]}' in report
    assert 'noise_std' not in report


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ('structure:=cascade', 'got structure set'),
        ('noise_std:=1000.0', 'd = 0'),
    ],
)
def test_bag_that_can_give_no_gains(bag, tmp_path, capsys, given, message):
    out = tmp_path / 'out'
    assert main(['--bag', str(bag), '-o', str(out), '-p', given]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


# ends


@pytest.mark.signals
def test_interrupt_keeps_the_best(tmp_path):
    out, storage = tmp_path / 'out', tmp_path / 'study.db'
    process = command(
        *QUICK, '--jobs=1', '--trials=1000000', '--storage', f'sqlite:///{storage}', '-o', out
    )
    try:
        wait_until(lambda: finished(storage) > 3, 'trial', process=process)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60.0)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, err
    assert sorted(path.name for path in out.iterdir()) == FILES
    load(out / 'gains.yaml', 'estimator')


def finished(storage):
    """Return how many trials the data base of a study holds."""
    if not storage.exists():
        return 0
    with closing(sqlite3.connect(storage)) as base:
        try:
            return base.execute("SELECT count(*) FROM trials WHERE state='COMPLETE'").fetchone()[0]
        except sqlite3.OperationalError:  # its tables are made right now
            return 0


def test_storage_holds_what_the_next_run_goes_on_with(tmp_path):
    storage = ['--storage', f'sqlite:///{tmp_path}/study.db', '--jobs=1']
    for trials in (4, 6):
        out = tmp_path / str(trials)
        assert main([*QUICK, *storage, f'--trials={trials}', '-o', str(out)]) == 0
        assert f'({trials} trials' in (out / 'gains.yaml').read_text()
    assert finished(tmp_path / 'study.db') == 6


# wrong input


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['-pnoise:=1'], "unknown parameter 'noise'"),
        (['-psearch:=[lamda]'], "'lamda'; did you mean 'lambda'"),
        (['-psearch:=["epsilon 3 1"]'], 'NAME LOW HIGH'),
        (['-psearch:=["epsilon 0 1 log"]'], 'NAME LOW HIGH'),
        (['-psearch:=[fuzzy_widths]', '-pvariant:=sign'], 'the variant sign uses'),
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
    assert main([*QUICK, '-o', 'out', *arguments]) == 2
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith('tune: error')]
    assert len(lines) == 1
    assert re.search(message, lines[0]), lines[0]
    assert list(tmp_path.iterdir()) == []


def test_missing_optuna_says_how_to_install_it(monkeypatch, capsys):
    from fhaosmo_ros.tools.cli import command as module

    monkeypatch.setattr(module, 'find_spec', lambda name: None)
    assert main([]) == 1
    assert "pip install 'optuna" in capsys.readouterr().err


# parts


@pytest.mark.parametrize(
    'truth',
    [
        {'noise_std': 1e-4},
        {'noise_std': 1e-2, 'sample_rate': 100.0},
        {'noise_std': 1e-3, 'stamp_jitter': 1e-4},
        {'noise_std': 1e-3, 'dropout': 0.1, 'dropout_length': 4.0},
        {'noise_std': 1e-3, 'quantisation': 1e-3},
        {'noise_std': 1e-3, 'disturbances': ['steps'], 'rms_of_d': 5.0},
    ],
)
def test_sensor_is_identified(truth):
    r = Family({'duration': 30.0, 'integration_step': 1e-3} | truth).recording(0)
    t = 1e5 + r.t
    sensor = identify(t, r.y)._asdict()
    assert sensor['sample_rate'] == pytest.approx(truth.get('sample_rate', 1000.0), rel=0.01)
    assert sensor['quantisation'] == pytest.approx(truth.get('quantisation', 0.0), rel=1e-3)
    assert sensor['stamp_jitter'] == pytest.approx(
        truth.get('stamp_jitter', 0.0), rel=0.1, abs=1e-9
    )
    assert sensor['dropout'] == pytest.approx(truth.get('dropout', 0.0), rel=0.2, abs=1e-3)


def test_sensor_outlives_bad_samples():
    r = Family({'noise_std': 1e-3, 'integration_step': 1e-3}).recording(0)
    y, t = r.y.copy(), r.t.copy()
    y[::500], y[7::700] = np.nan, 1e6
    t[1000] = t[990]
    assert identify(t, y).sample_rate == pytest.approx(1000.0, rel=1e-3)
    with pytest.raises(ConfigurationError, match='at least 200 samples'):
        identify(t[:100], y[:100])


def made_objective(monkeypatch, scores, **changes):
    """Return an objective of two recordings whose trial always has these scores."""
    recordings = Family(SHORT).recordings(2)
    objective = Objective(recordings, {}, TUNING.changed(changes), choose=True, scale=np.ones(4))
    monkeypatch.setattr(objective, 'trial', lambda parameters: scores)
    objective._truth_varies = np.ones(2)
    return objective


def made_scores(error=1.0, transient=0.0, variation=0.0):
    return Scores(
        np.broadcast_to(error, (2, 2, 4)),
        np.broadcast_to(transient, (2, 2)),
        np.broadcast_to(variation, (2, 2)),
    )


def test_error_is_a_geometric_mean_of_weighted_errors(monkeypatch):
    error = np.ones((2, 2, 4))
    error[:, :, 1], error[0, :, 3], error[1, :, 3] = 7.0, 4.0, 1.0
    found = made_objective(monkeypatch, made_scores(error), weights=[0.0, 1.0, 0.0, 3.0])({})
    each = np.sqrt([(49.0 + 3.0 * 16.0) / 4.0, (49.0 + 3.0) / 4.0])
    assert found.error == pytest.approx(np.sqrt(each[0] * each[1]))
    assert made_objective(monkeypatch, made_scores(error))({}).error == pytest.approx(2.0)


def test_chatter_and_settling_add_by_their_weights(monkeypatch):
    weights = {'chatter_weight': 0.5, 'settling_weight': 0.25, 'settled': 2.0}
    scores = made_scores(
        3.0, transient=[[1.0, 1.0], [2.0, 2.0]], variation=[[100.0] * 2, [0.1] * 2]
    )
    found = made_objective(monkeypatch, scores, **weights)({})
    # 100 times the variation of the truth is 2 decades; less variation than the truth is none.
    assert (found.error, found.chatter, found.settling) == pytest.approx((3.0, 1.0, 0.75))
    assert found.objective == pytest.approx(3.0 + 0.5 * 1.0 + 0.25 * 0.75)


def test_better_of_internal_and_filtered_is_chosen(monkeypatch):
    error = np.ones((2, 2, 4))
    for better, name in enumerate(('internal', 'filtered')):
        error[:, better], error[:, 1 - better] = 1.0, 2.0
        objective = made_objective(monkeypatch, made_scores(error.copy()))
        assert objective({}).estimate_from == name
        assert objective({'estimate_from': 'internal'}).error == pytest.approx(1.0 + better)


def searched(monkeypatch, cost):
    """Return the result of a search in lambda whose trials cost what `cost` says."""
    values = TUNING.changed({'recordings': 1, 'search': ['lambda 1 100'], 'noise_std': 1e-3})
    estimator = {'scheme': 'explicit', 'variant': 'sign', 'unknown_input': False}
    tuner = Tuner(simulated(values, 1), estimator, values, 1)
    monkeypatch.setattr(tuner, 'evaluate', cost)
    return tuner.search(20)


@pytest.mark.parametrize(('loss', 'rounds'), [(1e-4, True), (1e-1, False)])
def test_gains_are_rounded_only_where_that_costs_little(monkeypatch, loss, rounds):
    def cost(values):
        rounded = all(v == float(f'{v:.4g}') for v in values.values())
        return sum(values.values()) * (1.0 + loss * rounded)

    best = searched(monkeypatch, cost).best
    assert all(v == float(f'{v:.4g}') for v in best.values()) is rounds


def test_report_warns_of_overfitting_and_of_bounds():
    space = [Dimension('a', 1e-3, 1e3, 1.0), Dimension('b', 0.0, 1.0, 0.5, log=False)]
    middle = {'a': 1.0, 'b': 0.5}
    assert report.warnings(space, middle, 0.4, 0.49) == []
    (worse,) = report.warnings(space, middle, 0.4, 0.52)
    assert '1.30 times' in worse
    (bound,) = report.warnings(space, {'a': 1.1e-3, 'b': 0.5}, 0.4, 0.4)
    assert 'At their bounds: a;' in bound
    assert not report.at_bound(space[0], 3.0)  # in logarithms this is the middle


def test_estimate_that_left_the_finite_numbers_is_the_worst():
    recordings = Family(SHORT).recordings(1)
    wild = {'lambda': 1e6, 'alpha': 1e9, 'fuzzy_widths': 1e-12, 'epsilon': 1e12}
    objective = Objective(recordings, {'scheme': 'explicit'}, TUNING, choose=True)
    assert objective(wild).objective > 1e3
    assert not np.isnan(objective(wild).objective)
    assert Observer().order == 3


def test_levant_is_tuned_without_what_it_does_not_use(tmp_path):
    out = tmp_path / 'out'
    assert main([*QUICK, '-pstructure:=levant', '-pscheme:=implicit', '-o', str(out)]) == 0
    values = load(out / 'gains.yaml', 'estimator')
    assert values['structure'] == 'levant'
    assert 'alpha' not in values
    assert '| epsilon |' not in (out / 'report.md').read_text()
    assert values['epsilon'] == max(values['fuzzy_widths'])
    assert values['divergence_time'] == 0.1  # 20 samples at 200 Hz
    assert len(values['lambda']) == 4


def test_objective_weighs_what_it_is_told_to():
    recordings = Family(SHORT | {'noise_std': 1e-3}).recordings(2)
    gains = {'lambda': 5.0, 'alpha': 3.0, 'fuzzy_widths': 0.05, 'epsilon': 1.0}
    plain = {'chatter_weight': 0.0, 'settling_weight': 0.0}

    def judge(**changes):
        return Objective(recordings, {}, TUNING.changed(changes), choose=True)(gains)

    only_d = judge(**plain)
    assert only_d.objective == only_d.error
    scores, choice = only_d.scores, only_d.choice
    scale = np.sqrt(np.mean(np.concatenate([r.d[r.t >= 1.0] for r in recordings]) ** 2))
    expected = np.exp(np.mean(np.log(scores.error[:, choice, -1] / scale)))
    np.testing.assert_allclose(only_d.error, expected, rtol=1e-6)
    assert judge(weights=[1.0, 0.0, 0.0, 0.0], **plain).error < 0.1 * only_d.error
    both = judge(chatter_weight=2.0, settling_weight=3.0)
    np.testing.assert_allclose(
        both.objective, both.error + 2.0 * both.chatter + 3.0 * both.settling
    )
    assert both.settling > 0.0
    other = Objective(
        recordings, {'estimate_from': 'filtered'}, TUNING.changed(plain), choose=False
    )
    assert other(gains).estimate_from == 'filtered'
    assert other(gains).error >= only_d.error


def test_held_out_recordings_are_others_with_the_scale_of_the_training():
    values = TUNING.changed({'recordings': 2, 'held_out': 2, 'noise_std': 1e-3})
    data = simulated(values, 1)
    assert not any(np.array_equal(a.y, b.y) for a in data.training for b in data.held_out)
    tuner = Tuner(data, {'scheme': 'explicit', 'lambda': [1.0], 'alpha': [1.0]}, values, 1)
    assert tuner.training.trial.recordings == data.training
    assert tuner.held_out.trial.recordings == data.held_out
    np.testing.assert_array_equal(tuner.held_out.scale, tuner.training.scale)
