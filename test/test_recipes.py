# SPDX-License-Identifier: Apache-2.0
"""The recipes, that for events too: files that run, and pages that say what was measured."""

from itertools import groupby
import re

from fhaosmo_ros.core import OnlineEstimator
from fhaosmo_ros.core.simulation.plant import respond
import numpy as np
import pytest
from studies import events, evidence
from studies.harness import observed, SELF_TUNING
from studies.recipes import judging
from studies.recipes.__main__ import NAME, RECIPES
from studies.recipes.judging import FIXED, OURS

CHANNEL = {
    'encoder': 'from_joint_names', 'motor_load': 'servo', 'joint_torque': 'shoulder', 'wind': 'x',
    'sensor_bias': 'yaw', 'hidden_force': '',
}  # fmt: skip
SIMULATED = {
    'encoder': (1000.0, 5e-4, 20.0, 10.0, ()), 'motor_load': (190.0, 4e-4, 25.0, 6.0, (0.0, 1.0)),
    'joint_torque': (200.0, 0.02, 20.0, 6.0, (-1.57, 0.0, 0.0)),
    'wind': (100.0, 3.5e-3, 1.5, 1.0, (0.0,)),
    'sensor_bias': (100.0, 3.5e-3, 0.05, 0.2, (0.0, 0.0, 0.0, 0.0)),
    'hidden_force': (610.0, 1e-5, 4000.0, 200.0, ()),
}  # fmt: skip
"""Rate (Hz), noise, amplitude of d and its speed (rad/s), and means of the known inputs."""
recipes = pytest.mark.parametrize('name', RECIPES)


def results(name):
    """Return the lines of a recipe by method, a dict for each condition."""
    rows = [row for row in evidence.read(NAME) if row['recipe'] == name]
    return [
        {row['method']: row for row in group}
        for _, group in groupby(rows, lambda row: row['condition'])
    ]


def errors(condition, ours):
    return [row['error'] for name, row in condition.items() if name.startswith(OURS) == ours]


@recipes
def test_page_says_what_was_measured(name):
    page = (evidence.DOCS / 'recipes.md').read_text(encoding='utf-8')
    [row] = [x for x in evidence.parts(page)['ratios'].splitlines() if f'`{name}.yaml`' in x]
    shown = re.findall(r'\d\.\d\d', row.split('|')[-2])
    found = [f'{min(errors(c, True)) / min(errors(c, False)):.2f}' for c in results(name)]
    assert shown == (found if len(found) < 3 else [min(found), max(found)])
    assert all(list(condition) == list(RECIPES[name].methods) for condition in results(name))


@recipes
def test_file_has_the_gains_that_are_better(name):
    found = OnlineEstimator.from_yaml(
        judging.CONFIG / f'{name}.yaml', channel=CHANNEL[name]
    ).parameters
    condition = results(name)[0]
    ours = min(errors(condition, True))
    if found['gains'] == 'self_tuning':  # nothing to tune is worth a tenth
        assert FIXED not in condition or ours < 1.1 * condition[FIXED]['error']
        return
    assert condition[FIXED]['error'] < ours, 'the file may as well have gains: self_tuning'
    poles = {'hidden_force': (4, 6, 4, 1)}[name]
    wanted = [c * condition[FIXED]['chosen'] ** (k + 1) for k, c in enumerate(poles)]
    np.testing.assert_allclose(found['lambda'], wanted, rtol=5e-3)


@recipes
def test_file_runs_as_the_node_would_run_it(name):
    parameters, (rate, noise, size, speed, means) = judging.model(name), SIMULATED[name]
    t = np.arange(0.0, 4.0, 1.0 / rate)
    u = np.add.outer(0.1 * np.sin(2.0 * t), means or (0.0,))
    d = size * np.sin(speed * t)
    z, _ = respond(judging.plant_of(parameters), 0.0, t, d, t[1], u, step=t[1] / 2.0)
    y, u = z[:, 0] + noise * np.random.default_rng(0).standard_normal(len(t)), u if means else None
    estimator = OnlineEstimator.from_yaml(judging.CONFIG / f'{name}.yaml', channel=CHANNEL[name])
    stamps = 10**9 + np.round(t * 1e9).astype(np.int64)
    found = estimator.run(stamps, y, u)
    assert np.isfinite(found.z).all()
    assert estimator.counters.accepted >= 0.99 * len(t)
    if estimator.parameters['gains'] == 'self_tuning' and name != 'motor_load':
        lag = {'smoothing_lag': estimator.parameters['smoothing_lag']}
        same = observed(parameters | SELF_TUNING | lag, t, y, u)
        np.testing.assert_array_equal(found.unknown_input, same.unknown_input)


# Events


NODE_PAGE = (evidence.DOCS / 'node.md').read_text(encoding='utf-8')
EVENTS = NODE_PAGE.split('## Events')[1].split('\n## ')[0]


@pytest.mark.parametrize('factor', events.FACTORS)
def test_the_file_of_the_page_finds_faults_and_nothing_else(tmp_path, factor):
    path = tmp_path / 'faults.yaml'
    path.write_text(EVENTS.split('```yaml\n')[1].split('```')[0])
    r = events.record(0.07, 5, factor * events.NOISE, faults=True)
    found = OnlineEstimator.from_yaml(path)
    found.run(np.round(1e9 * events.H * np.arange(len(r.y))).astype(np.int64), r.y)
    begun = np.array([e.stamp * 1e-9 for e in found.events.taken() if e.begins])
    late = events.delays(begun, r.faults)
    assert len(late) >= 8
    assert np.isfinite(late).all()
    assert np.median(late) < 0.35
    quiet = begun[begun < r.faults[0]]
    assert not len(quiet[quiet > 10.0])
