# SPDX-License-Identifier: Apache-2.0
"""The recipes, that for events too: files that run, and pages that say what was measured."""

from itertools import groupby
import re

from fhaosmo_ros.core import OnlineEstimator
import numpy as np
import pytest
from studies import events, evidence
from studies.recipes import judging
from studies.recipes.__main__ import NAME, RECIPES
from studies.recipes.judging import OURS

CHANNEL = {
    'encoder': 'from_joint_names', 'motor_load': 'servo', 'joint_torque': 'shoulder', 'wind': 'x',
    'sensor_bias': 'yaw', 'hidden_force': '',
}  # fmt: skip
recipes = pytest.mark.parametrize('name', RECIPES)


def errors(condition, ours):
    return [row['error'] for row in condition if row['method'].startswith(OURS) == ours]


@recipes
def test_page_says_what_was_measured(name):
    page = (evidence.DOCS / 'recipes.md').read_text(encoding='utf-8')
    [row] = [x for x in evidence.parts(page)['ratios'].splitlines() if f'`{name}.yaml`' in x]
    rows = [row for row in evidence.read(NAME) if row['recipe'] == name]
    conditions = [[*group] for _, group in groupby(rows, lambda row: row['condition'])]
    for condition in conditions:
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
