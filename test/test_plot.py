# SPDX-License-Identifier: Apache-2.0
"""Figures and tables of plot and demo, from a bag whose errors are known."""

import bag_files as files
from fhaosmo_ros.core import OnlineEstimator
from fhaosmo_ros.tools import plot
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.types import labelled_array
from fhaosmo_ros.tools.demo import observers, OTHERS, report, START
from fhaosmo_ros.tools.plot import COLUMNS, envelope, read_curves
from fhaosmo_ros.topics import ARRAY, FLOAT, TIME
import numpy as np
import pytest

COUNT, FIRST, PERIOD = 401, 50, 0.01
KNOWN = range(70, 390)
T = PERIOD * np.arange(COUNT)
NAMES = ['z1', 'z2', 'z3', 'd']
SIZES = np.array([1.0, 3.0, 0.2, 0.05])
"""Amplitude of each state and of d."""
TRUTH = SIZES * np.sin(0.5 * np.pi * T)[:, None]
ERROR = np.select([T < 2.5, T < 3.5], [0.1, 0.01], 0.03)
"""Relative to the amplitude; the sign alternates."""
ESTIMATE = TRUTH + SIZES * (ERROR * (-1.0) ** np.arange(COUNT))[:, None]


@pytest.fixture(scope='module', name='bag')
def _bag(tmp_path_factory):
    """Write a run of which the recorder missed estimates before `FIRST`, and some of the truth."""
    messages = []
    for k in range(COUNT):
        stamp = files.ORIGIN + round(k * PERIOD * 1e9)
        rows = [('/y', FLOAT, 0, files.float64(TRUTH[k, 0]))]
        if k in KNOWN:
            rows += [
                ('/plant/state', ARRAY, 20_000, labelled_array(NAMES[:3], TRUTH[k, :3])),
                ('/plant/unknown_input', FLOAT, 40_000, files.float64(TRUTH[k, 3])),
            ]
        of_estimate = [
            ('state', ARRAY, labelled_array(NAMES[:3], ESTIMATE[k, :3])),
            ('unknown_input', FLOAT, files.float64(ESTIMATE[k, 3])),
            ('innovation', ARRAY, labelled_array(['eps1'], np.zeros(1))),
            ('stamp', TIME, files.serialise(TIME, sec=stamp // 10**9, nanosec=stamp % 10**9)),
        ]
        for number, (name, kind, data) in enumerate(of_estimate if k >= FIRST else ()):
            rows.append((f'/estimator/{name}', kind, 10**6 + 10**4 * number, data))
        messages += [(topic, kind, stamp + delay, data) for topic, kind, delay, data in rows]
    return files.write(tmp_path_factory.mktemp('demo') / 'bag', messages)


def test_truth_is_unknown_where_the_bag_lacks_it(bag, tmp_path, capsys):
    (curves,) = read_curves(bag, [], '/plant')
    known = np.isfinite(curves.truth).all(axis=1)
    assert known.tolist() == [k in KNOWN for k in range(FIRST, COUNT)]
    assert plot.main([str(bag), '-o', str(tmp_path / 'figure.pdf')]) == 0
    assert (tmp_path / 'figure.pdf').read_bytes().startswith(b'%PDF-')
    said = capsys.readouterr().out
    assert 'bag /estimator' in said
    assert 'nan' not in said
    other = curves._replace(names=['z1', 'd'], estimate=curves.estimate[:, ::3], truth=None)
    plot.save_curves([other._replace(unit='rad'), curves], tmp_path / 'both.svg')
    drawn = (tmp_path / 'both.svg').read_text()
    assert '<!-- true -->' in drawn
    assert '<!-- input d [rad/s] -->' in drawn


def test_table_says_the_errors_that_are_in_the_bag(bag):
    (live,) = observers(bag, {'gains': 'self_tuning'})
    assert live.names == NAMES
    t = (live.stamps - live.stamps[0]) * 1e-9
    np.testing.assert_allclose(t, T[KNOWN] - T[KNOWN][0], rtol=0.0, atol=1e-12)
    head, *rows = report([live], []).splitlines()
    assert head.startswith('from 2 s')
    late = np.array(KNOWN)[t >= START]
    for k, row in enumerate(rows):
        error = np.sqrt(np.mean((ESTIMATE - TRUTH)[late, k] ** 2))
        moved = [np.abs(np.diff(x[late, k])).sum() for x in (ESTIMATE, TRUTH)]
        assert [float(x) for x in row.split()[-2:]] == pytest.approx(
            [error, moved[0] / moved[1]], rel=0.01
        )
    assert [row.split()[3] for row in rows] == NAMES


def test_other_observers_go_through_the_same_samples(bag):
    """What changes begins a table."""
    live, *others = observers(bag, {'gains': 'fixed'})
    assert [c.label for c in others] == [*OTHERS]
    with BagReader(bag) as reader:
        y = reader.samples('/y')
    alone = OnlineEstimator([*OTHERS.values()][1]).run(y.stamps, y.values)
    np.testing.assert_array_equal(others[1].estimate[:, 0], alone.unknown_input[KNOWN])
    text = report([live, *others], [(files.ORIGIN + 3 * 10**9, 'noise')])
    assert text.count('fuzzy, the power held') == 2
    assert 'from 2 s' in text


def test_thinned_curve_keeps_its_ends_its_extremes_and_its_gaps():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 100.0, 200_000)) ** 2  # a rate that changes
    curves = [np.sin(t * 1e-3), rng.normal(size=len(t)), np.where(t % 2000 < 500, np.nan, t)]
    curves[0][777] = 9.0  # one spike
    t[100_000:] += 500.0  # a gap
    for count in (0, 1, 100):
        assert envelope(t[:count], t[:count])[1].tolist() == t[:count].tolist()
    for x in curves:
        thin = envelope(t, x)
        assert len(thin[0]) <= 2 * COLUMNS + 2
        assert [np.nanmin(thin[1]), np.nanmax(thin[1])] == [np.nanmin(x), np.nanmax(x)]
        assert (thin[0][0], thin[0][-1]) == (t[0], t[-1])
        assert np.isnan(thin[1]).any() == np.isnan(x).any()
