# SPDX-License-Identifier: Apache-2.0
"""The recipes, that for events too: files that run, and pages that say what was measured."""

from itertools import groupby
import re

from fhaosmo_ros.core import OnlineEstimator, TriangularModel
from fhaosmo_ros.core.simulation.plant import respond
import numpy as np
import pytest
from studies import evidence
from studies.recipes import judging
from studies.recipes.__main__ import NAME, RECIPES
from studies.recipes.judging import OURS

CHANNEL = {
    'encoder': 'from_joint_names', 'motor_load': 'servo', 'joint_torque': 'shoulder', 'wind': 'x',
    'sensor_bias': 'yaw', 'hidden_force': '',
}  # fmt: skip
recipes = pytest.mark.parametrize('name', CHANNEL)


def errors(condition, ours):
    return [row['error'] for row in condition if row['method'].startswith(OURS) == ours]


@recipes
def test_page_says_what_was_measured(name):
    page = (evidence.DOCS / 'recipes.md').read_text(encoding='utf-8')
    [row] = [x for x in evidence.parts(page)['ratios'].splitlines() if f'`{name}.yaml`' in x]
    rows = [row for row in evidence.read(NAME) if row['recipe'] == name]
    conditions = [[*group] for _, group in groupby(rows, lambda row: row['condition'])]
    for condition in conditions if name in RECIPES else ():
        assert [row['method'] for row in condition] == list(RECIPES[name].methods)
    found = [f'{min(errors(c, True)) / min(errors(c, False)):.2f}' for c in conditions]
    shown = re.findall(r'\d\.\d\d', row.split('|')[-2])
    assert shown == (found if len(found) < 3 else [min(found), max(found)])


@recipes
def test_file_runs_as_the_node_would_run_it(name):
    """On a sine: what it estimates is not the point, but that it takes the samples."""
    estimator = OnlineEstimator.from_yaml(judging.CONFIG / f'{name}.yaml', channel=CHANNEL[name])
    stamps = 10**9 + np.arange(1000) * 5_000_000
    noise = 1e-3 * np.random.default_rng(0).standard_normal(1000)
    u = np.full((1000, len(estimator.inputs)), 0.1)
    found = estimator.run(stamps, 0.1 * np.sin(stamps * 2e-9) + noise, u)
    assert np.isfinite(found.z).all()
    assert estimator.counters.accepted >= 990


@pytest.mark.parametrize('noise', [1e-3, 3e-3])
def test_the_file_of_the_page_finds_faults_and_nothing_else(tmp_path, noise):
    """A joint at 100 Hz with a small load, and faults of 1 that last 2 s."""
    path, page = tmp_path / 'faults.yaml', (evidence.DOCS / 'node.md').read_text(encoding='utf-8')
    path.write_text(page.split('## Events')[1].split('```yaml\n')[1].split('```')[0])
    t, begins = np.arange(0.0, 250.0, 0.01), np.arange(65.0, 240.0, 20.0)
    since = t - np.append(-np.inf, begins)[np.searchsorted(begins, t, side='right')]
    d = 0.03 * (np.sin(0.3 * t) + np.sin(0.9 * t)) + (since < 2.0)
    z, _ = respond(TriangularModel(['0', '-z2']), 0.0, t, d, 0.01)
    y = z[:, 0] + noise * np.random.default_rng(5).standard_normal(len(t))
    found = OnlineEstimator.from_yaml(path)
    found.run(np.round(1e9 * t).astype(np.int64), y)
    begun = np.array([e.stamp * 1e-9 for e in found.events.taken() if e.begins])
    assert not np.any((begun > 10.0) & (begun < begins[0]))
    late = np.append(begun, np.inf)[np.searchsorted(begun, begins)] - begins
    assert np.all(late < 2.0)
    assert np.median(late) < 0.35
