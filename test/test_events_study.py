# SPDX-License-Identifier: Apache-2.0
"""The recipe for events, in short: its file runs, and faults are found as its page says."""

from fhaosmo_ros.core import OnlineEstimator
import numpy as np
import pytest
from studies import events, evidence

PAGE = (
    (evidence.DOCS / 'node.md').read_text(encoding='utf-8').split('## Events')[1].split('\n## ')[0]
)


@pytest.fixture(scope='module')
def estimator(tmp_path_factory):
    path = tmp_path_factory.mktemp('events') / 'faults.yaml'
    path.write_text(PAGE.split('```yaml\n')[1].split('```')[0])
    return lambda: OnlineEstimator.from_yaml(path)


@pytest.mark.parametrize('factor', events.FACTORS)
def test_the_file_of_the_page_finds_faults_and_nothing_else(estimator, factor):
    noise = factor * events.NOISE
    r = events.record(0.07, 5, noise, faults=True)
    found = estimator()
    found.run(np.round(1e9 * events.H * np.arange(len(r.y))).astype(np.int64), r.y)
    begun = np.array([e.stamp * 1e-9 for e in found.events.taken() if e.begins])
    late = events.delays(begun, r.faults)
    assert len(late) >= 8
    assert np.isfinite(late).all()
    assert np.median(late) < 0.35
    quiet = begun[begun < r.faults[0]]
    assert not len(quiet[quiet > 10.0])


def test_the_filter_beside_it_follows_a_fault_and_smooths_a_load():
    r = events.record(0.05, 6)
    slow, quick = (events.kalman(r.y, intensity)[0][2000:] - r.d[2000:] for intensity in (1e-2, 1))
    assert np.std(slow) < np.std(quick) < events.FAULT


@pytest.fixture(scope='module')
def documented():
    return evidence.read(events.NAME)


def test_the_page_says_what_was_measured(documented):
    told, changed = events.FACTORS
    for name in (events.FILTER, events.OURS):
        point = events.best(events.points_of(documented, told, name))
        [kept] = [
            p for p in events.points_of(documented, changed, name)
            if p.threshold == point.threshold
        ]  # fmt: skip
        assert f'{point.delay:.2f} s' in PAGE
        assert f'{kept.false:.1f}' in PAGE or f'{kept.false:,.0f}' in PAGE


@pytest.mark.parametrize(
    ('name', 'seconds', 'late'), [(events.FILTER, 1800.0, 0.02), (events.OURS, 600.0, 0.05)]
)
def test_a_short_new_run_agrees_with_the_results(documented, name, seconds, late):
    """The first part of the same recordings."""
    factor, count = events.FACTORS[1], round(seconds / events.H)
    quiet = events.record(seconds / 3600.0, 1, factor * events.NOISE)
    faulty = events.record(0.1 * events.HOURS, 2, factor * events.NOISE, faults=True)
    faults = faulty.faults[faulty.faults < seconds - events.LASTS]
    if name == events.OURS:
        both, deviations = [events.self_tuning(y) for y in (quiet.y, faulty.y[:count])], 5.0
    else:
        intensity = documented[0]['intensity']
        both = [events.kalman(y, intensity) for y in (quiet.y, faulty.y[:count])]
        deviations = 0.0
    new = events.curve(*both, faults, deviations)
    old = events.points_of(documented, factor, name)
    for k in (5, 8, 11):
        assert new[k].threshold == pytest.approx(old[k].threshold, rel=1e-5)
        assert new[k].delay == pytest.approx(old[k].delay, abs=late)
        expected, counted = (p.false * seconds / 3600.0 for p in (old[k], new[k]))
        assert abs(counted - expected) < 4.0 * np.sqrt(expected) + 1.5  # Poisson
