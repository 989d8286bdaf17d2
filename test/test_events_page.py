# SPDX-License-Identifier: Apache-2.0
"""The recipe for events, in short: its file runs, and faults are found as its page says."""

from pathlib import Path

from fhaosmo_ros.core import OnlineEstimator
import numpy as np
import pytest
from studies import events

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'events.md'


@pytest.fixture(scope='module')
def estimator(tmp_path_factory):
    path = tmp_path_factory.mktemp('events') / 'faults.yaml'
    path.write_text(PAGE.read_text().split('```yaml\n')[1].split('```')[0])
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


def test_the_filter_beside_it_is_a_kalman_filter():
    r = events.record(0.05, 6)
    d, deviation = events.kalman(r.y, 1e-2)
    late = slice(2000, None)
    # White noise of its innovations' size in, and as sure as it is: d is nearly at rest here.
    assert np.std((d - r.d)[late]) < 1.3 * deviation[0]
    assert np.std((d - r.d)[late]) < np.std(events.kalman(r.y, 1.0)[0][late] - r.d[late])
