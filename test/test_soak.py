# SPDX-License-Identifier: Apache-2.0
"""A soak's schedule and verdict: what it must notice, planted. The soak itself is `make soak`."""

from collections import Counter
import importlib
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

BENCHMARK = Path(__file__).resolve().parents[1] / 'benchmark'


@pytest.fixture(name='plan')
def _plan(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARK)
    return importlib.import_module('soak_schedule')


@pytest.fixture(name='judge')
def _judge(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARK)
    return importlib.import_module('soak_verdict')


def course(judge, **changes):
    """Return a course in which all is well, with changes."""
    t = np.arange(20.0, 1800.0)
    noise = np.random.default_rng(0).normal(0.0, 0.05, len(t))
    cycles = np.arange(1.0, 91.0) * 20.0
    values = {
        'memory': {'estimator': np.column_stack([t, 200.0 + noise])},
        'windows': np.column_stack(
            [cycles, np.full(90, 0.004), np.full(90, 0.5)],
        ),
        'outputs': 1000, 'not_finite': 0, 'published': 900, 'taken': 900, 'lost': 0, 'stalls': 0,
        'faults': Counter(), 'calls': Counter({'reset': 3}),
    }  # fmt: skip
    return judge.Course(**values | changes)


def test_same_seed_same_faults_of_every_kind(plan):
    events = plan.schedule(7, 120.0)
    assert events == plan.schedule(7, 120.0)
    assert events != plan.schedule(8, 120.0)
    assert {event.kind for event in events} == {*plan.STREAM, *plan.CALLS}


@pytest.mark.parametrize('seconds', [120.0, 1800.0])
def test_judged_seconds_are_without_faults(plan, seconds):
    for event in plan.schedule(1, seconds):
        cycle, phase = divmod(event.time, plan.CYCLE)
        assert cycle >= 1
        assert event.time < seconds
        assert phase < plan.RESTORE < plan.JUDGED[0]


def test_healthy_course_passes(judge):
    assert [row.name for row in judge.verdict(course(judge)) if row.missed] == []


def leak(rate):
    t = np.arange(20.0, 1800.0)
    return {'estimator': np.column_stack([t, 200.0 + rate * t])}


def windows(error=0.004, gamma=0.5):
    return np.column_stack(np.broadcast_arrays(np.arange(1.0, 91.0) * 20.0, error, gamma))


@pytest.mark.parametrize(
    ('name', 'changes'),
    [
        ('memory of estimator, growth', {'memory': leak(0.002)}),
        ('samples unaccounted for', {'taken': 899}),
        ('samples unaccounted for', {'taken': 901}),
        ('samples lost, by sequence number', {'lost': 1}),
        ('outputs that are not finite', {'not_finite': 1}),
        ('error of d, growth', {'windows': windows(error=np.linspace(0.004, 0.04, 90))}),
        ('error of d, worst window', {'windows': windows(error=0.06)}),
        ('error of d, worst window', {'windows': windows(error=float('nan'))}),
        ('gamma, drift', {'windows': windows(gamma=np.linspace(0.5, 0.6, 90))}),
        ('wrong answers to calls', {'calls': Counter({'reset': 3, 'wrong answers': 1})}),
    ],
)
def test_verdict_notices(judge, name, changes):
    missed = [row.name for row in judge.verdict(course(judge, **changes)) if row.missed]
    assert name in missed


def test_figure_is_drawn(judge, tmp_path):
    judge.draw(course(judge), tmp_path / 'soak.png')
    assert (tmp_path / 'soak.png').read_bytes().startswith(b'\x89PNG')


def test_too_short_is_refused():
    done = subprocess.run(
        [sys.executable, BENCHMARK / 'soak.py', '--minutes', '0.5'],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert 'expected at least 2, got 0.5' in done.stderr
