# SPDX-License-Identifier: Apache-2.0
"""A soak's schedule and verdict: what it must notice, planted. The soak itself is `make soak`."""

from collections import Counter
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
import soak
import soak_schedule as plan
import soak_verdict as judge

BENCHMARK = Path(__file__).resolve().parents[1] / 'benchmark'


def course(**changes):
    """Return a course in which all is well, with changes."""
    t = np.arange(20.0, 1800.0)
    noise = np.random.default_rng(0).normal(0.0, 0.05, len(t))
    cycles = np.arange(1.0, 91.0) * 20.0
    values = {
        'memory': {'estimator': np.column_stack([t, 200.0 + noise])},
        'windows': np.column_stack(
            [cycles, np.full(90, 0.004), np.full(90, 0.5)],
        ),
        'outputs': 1000, 'not_finite': 0, 'published': 900, 'taken': 900, 'lost': 0,
        'losses': np.empty(0), 'late': np.zeros(1800), 'busy': np.zeros(1800), 'faults': Counter(),
        'calls': Counter({'reset': 3}),
    }  # fmt: skip
    return judge.Course(**values | changes)


def test_same_seed_same_faults_of_every_kind():
    events = plan.schedule(7, 120.0)
    assert events == plan.schedule(7, 120.0)
    assert events != plan.schedule(8, 120.0)
    assert {event.kind for event in events} == {*plan.STREAM, *plan.CALLS}


@pytest.mark.parametrize('seconds', [120.0, 1800.0])
def test_judged_seconds_are_without_faults(seconds):
    for event in plan.schedule(1, seconds):
        cycle, phase = divmod(event.time, plan.CYCLE)
        assert cycle >= 1
        assert event.time < seconds
        assert phase < plan.RESTORE < plan.JUDGED[0]


def test_healthy_course_passes():
    assert [row.name for row in judge.verdict(course()) if row.missed] == []


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
        ('samples unaccounted for', {'taken': 899, 'lost': 2}),
        ('samples lost, by sequence number', {'taken': 899, 'lost': 1}),
        ('outputs that are not finite', {'not_finite': 1}),
        ('error of d, growth', {'windows': windows(error=np.linspace(0.004, 0.04, 90))}),
        ('error of d, worst window', {'windows': windows(error=0.06)}),
        ('error of d, worst window', {'windows': windows(error=float('nan'))}),
        ('gamma, drift', {'windows': windows(gamma=np.linspace(0.5, 0.6, 90))}),
        ('wrong answers to calls', {'calls': Counter({'reset': 3, 'wrong answers': 1})}),
    ],
)
def test_verdict_notices(name, changes):
    missed = [row.name for row in judge.verdict(course(**changes)) if row.missed]
    assert name in missed


def late(*seconds, by=0.5):
    values = np.zeros(1800)
    values[list(seconds)] = by
    return values


def lossy(**changes):
    return {'taken': 899, 'lost': 1, 'losses': np.array([503.0])} | changes


BAD_WINDOWS = windows(error=np.where(np.arange(90) == 40, 0.06, 0.004))  # at 820 s
GREW = windows(error=np.where(np.arange(90) > 60, 0.03, 0.004))
NAN = windows(error=np.where(np.arange(90) == 40, float('nan'), 0.004))


@pytest.mark.parametrize(
    ('code', 'changes'),
    [
        (0, {}),
        (0, {'late': late(*range(1800))}),
        (3, lossy(late=late(500))),
        (3, lossy(late=late(502))),
        (1, lossy()),
        (1, lossy(late=late(499))),  # too early
        (1, lossy(late=late(503))),  # too late
        (1, lossy(late=late(502, by=0.01))),  # too short
        (1, lossy(late=late(502), losses=np.array([503.0, 700.0]))),  # a second loss without one
        (1, lossy(late=late(502), taken=898)),  # and one that nobody counted
        (1, lossy(late=late(502), not_finite=1)),
        (1, lossy(late=late(502), memory=leak(0.002))),
        (1, lossy(late=late(502), calls=Counter({'wrong answers': 1}))),
        (3, {'windows': BAD_WINDOWS, 'busy': late(817)}),
        (1, {'windows': BAD_WINDOWS, 'busy': late(817, by=0.1)}),
        (1, {'windows': BAD_WINDOWS, 'busy': late(825)}),
        (3, {'windows': GREW, 'busy': late(*range(1200, 1800), by=0.2)}),
        (1, {'windows': GREW, 'busy': late(*range(1200, 1700), by=0.2)}),
        (1, {'windows': NAN, 'busy': late(*range(1800))}),
        (1, {'windows': windows(gamma=np.linspace(0.5, 0.6, 90)), 'late': late(*range(1800))}),
        (1, {'memory': leak(0.002), 'late': late(*range(1800))}),
    ],
)
def test_only_what_a_stall_explains_is_tried_again(code, changes, monkeypatch, tmp_path):
    courses = []
    monkeypatch.setattr(soak, 'run', lambda *_: courses.append(course(**changes)) or courses[-1])
    monkeypatch.setattr(soak, 'isolate', lambda: None)
    monkeypatch.setattr(judge, 'draw', lambda *_: None)
    assert soak.main(['--retries', '2', '--output', str(tmp_path)]) == code
    assert len(courses) == (3 if code == 3 else 1)


def test_figure_is_drawn(tmp_path):
    judge.draw(course(), tmp_path / 'soak.png')
    assert (tmp_path / 'soak.png').read_bytes().startswith(b'\x89PNG')


def test_too_short_is_refused():
    done = subprocess.run(
        [sys.executable, BENCHMARK / 'soak.py', '--minutes', '0.5'],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert 'expected at least 2, got 0.5' in done.stderr
