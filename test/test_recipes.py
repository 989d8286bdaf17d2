# SPDX-License-Identifier: Apache-2.0
"""The recipes: short runs, and pages, files and results that say the same."""

import json
from pathlib import Path

from fhaosmo_ros.core import OnlineEstimator
import numpy as np
import pytest
from studies import document
from studies.recipes import judging, page, peers
from studies.recipes.command import main, RECIPES
from studies.recipes.judging import FIXED, OURS

DOCS = Path(__file__).resolve().parents[1] / 'docs'
CHANNEL = {
    'encoder': 'from_joint_names', 'motor_load': 'servo', 'joint_torque': 'shoulder', 'wind': 'x',
    'sensor_bias': 'yaw', 'hidden_force': '',
}  # fmt: skip
recipes = pytest.mark.parametrize('name', RECIPES)


def results(name):
    return json.loads((DOCS / f'{name}.json').read_text())['errors']


@recipes
def test_short_run_prints_all_methods_and_their_errors(name, capsys):
    assert main([name, '--short']) == 0
    printed = capsys.readouterr().out
    rows = [line.split('|') for line in printed.splitlines() if line.count('|') == 4][2:]
    assert [row[1].strip() for row in rows] == list(RECIPES[name].METHODS)
    errors = {row[1].strip(): float(row[3]) for row in rows}
    assert errors.pop(OURS) < 1.01  # no worse than an estimate of 0
    assert max(errors.values()) < 0.5


@recipes
def test_page_says_what_was_measured(name):
    text = (DOCS / f'{name}.md').read_text()
    assert document.parts(text)[page.PART] == page.table(results(name))
    for condition in results(name).values():
        assert list(condition) == list(RECIPES[name].METHODS)


@recipes
def test_file_has_the_gains_that_are_better(name):
    found = OnlineEstimator.from_yaml(
        judging.CONFIG / f'{name}.yaml', channel=CHANNEL[name]
    ).parameters
    condition = next(iter(results(name).values()))
    ours = min(row['error'] for method, row in condition.items() if method.startswith(OURS))
    if found['gains'] == 'self_tuning':  # nothing to tune is worth a tenth
        assert FIXED not in condition or ours < 1.1 * condition[FIXED]['error']
        return
    assert condition[FIXED]['error'] < ours, 'the file may as well have gains: self_tuning'
    [bandwidth] = condition[FIXED]['chosen']
    poles = {'hidden_force': (4, 6, 4, 1)}[name]
    wanted = [c * bandwidth ** (k + 1) for k, c in enumerate(poles)]
    np.testing.assert_allclose(found['lambda'], wanted, rtol=5e-3)


@recipes
def test_file_runs_as_the_node_would_run_it(name):
    [fold] = RECIPES[name].short()['simulated']
    r = fold.judged[0]
    estimator = OnlineEstimator.from_yaml(judging.CONFIG / f'{name}.yaml', channel=CHANNEL[name])
    stamps = 10**9 + np.round(r.t * 1e9).astype(np.int64)
    found = estimator.run(stamps, r.y, r.u if r.u.size else None)
    assert np.isfinite(found.z).all()
    assert estimator.counters.accepted >= 0.99 * len(r.t)
    if estimator.parameters['gains'] == 'self_tuning' and name != 'motor_load':
        lag = {'smoothing_lag': estimator.parameters['smoothing_lag']}
        same = judging.run(fold.parameters | judging.SELF_TUNING | lag, r)
        np.testing.assert_array_equal(found.unknown_input, same.unknown_input)


@pytest.mark.parametrize(
    'peer', [peers.disturbance_observer, peers.kalman_filter], ids=lambda p: p.__name__
)
def test_peers_find_a_constant_d(peer):
    """Without noise, a quick peer has the truth after some time constants."""
    t = np.arange(0.0, 2.0, 2e-3)
    p = {'order': 2, 'phi': ['0', 'u - 3*z1']}
    w = np.sqrt(3.0)
    y = (0.7 + 0.2) / 3.0 * (1.0 - np.cos(w * t))  # z1'' = 0.2 + 0.7 - 3 z1
    r = judging.Recorded('', t, y, np.full((len(t), 1), 0.2), np.full_like(t, 0.7), t > 1.0)
    assert judging.error([(r, peer(p, r, 60.0))]) < 0.03


def test_complementary_filter_finds_a_constant_bias():
    t = np.arange(0.0, 10.0, 0.01)
    rate = np.sin(t)
    y = 1.0 - np.cos(t)
    r = judging.Recorded('', t, y, rate[:, None] + 0.1, np.full_like(t, -0.1), t > 8.0)
    found = peers.complementary_filter({'order': 1, 'phi': ['u']}, r, 2.0)
    assert judging.error([(r, found)]) < 0.05
