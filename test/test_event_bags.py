# SPDX-License-Identifier: Apache-2.0
"""Events, standard deviations and tuning of a replay: in bags, in tables and in figures."""

import bag_files as files
from fhaosmo_ros.core import OnlineEstimator
from fhaosmo_ros.core.observer.estimates import TUNING
from fhaosmo_ros.core.observer.status import REJECTED
from fhaosmo_ros.tools.bags.topics import messages, series
from fhaosmo_ros.tools.plot import command as plot
from fhaosmo_ros.tools.plot.curves import read_curves
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest

FIRST_SAMPLES = 50
"""Samples from which a self-tuning estimator begins, at most."""
MODEL = {'order': 1, 'phi': ['-z1'], 'gains': 'self_tuning', 'event_deviations': 5.0}
OPTIONS = [word for name, value in MODEL.items() for word in ('-p', f'{name}:={value}')]


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """A bag of 16 s at 100 Hz of z1' = -z1 + d, d = 1 from 10 s to 14 s, and its samples."""
    stamps = files.ORIGIN + 10_000_000 * np.arange(1600)
    d = (np.arange(1600) > 1000) & (np.arange(1600) < 1400)
    z = np.zeros(1600)
    for k in range(1599):
        z[k + 1] = 0.99 * z[k] + 0.01 * d[k]
    y = z + 1e-3 * np.random.default_rng(2).standard_normal(1600)
    folder = tmp_path_factory.mktemp('events')
    bag = files.write(folder / 'bag', files.floats(stamps, y))
    outputs = [folder / name for name in ('out', 'out.csv', 'out.npz')]
    words = [word for output in outputs for word in ('-o', str(output))]
    assert replay.main([str(bag), *words, *OPTIONS]) == 0
    estimator = OnlineEstimator(MODEL)
    rows = estimator.run(stamps, y)
    used = (rows.status & REJECTED) == 0
    lasts = np.zeros(len(y), dtype=int)
    events = estimator.events.taken()
    for event in events:
        lasts[event.sample :] = event.begins
    return outputs, rows.standard_deviation[used], lasts[used], events


@pytest.fixture(scope='module')
def tuning(recorded):
    """What a node's estimator has found after each sample that it uses, one by one."""
    (bag, *_), *_ = recorded
    estimator, found = OnlineEstimator(MODEL), []
    y = series(bag, '/y')
    for stamp, value in zip(y.stamps.tolist(), y.values.tolist(), strict=True):
        if not estimator.update(stamp, value).status.rejected:
            noise, correlation, bandwidth, shares = estimator.observer.tuning
            found.append([noise, correlation, bandwidth, *shares])
    return np.array(found)


def test_tuning_is_the_nodes_to_the_last_bit(recorded, tuning):
    (bag, csv, npz), *_ = recorded
    of_bag = series(bag, '/estimator/tuning')
    assert of_bag.labels == TUNING
    np.testing.assert_array_equal(of_bag.values, tuning)
    known = np.isfinite(tuning).all(axis=1)
    assert 0 < np.argmax(known) <= FIRST_SAMPLES
    assert known[FIRST_SAMPLES:].all()
    np.testing.assert_allclose(tuning[known, 3:].sum(axis=1), 1.0, rtol=1e-12)
    assert tuning[-1, 0] == pytest.approx(1e-3, rel=0.15)
    of_csv = np.genfromtxt(csv, delimiter=',', names=True)
    with np.load(npz) as of_npz:
        for name, column in zip(TUNING, tuning.T, strict=True):
            np.testing.assert_array_equal(of_npz[f'tuning_{name}'], column)
            np.testing.assert_array_equal(of_csv[f'tuning_{name}'], column)


def test_the_bag_has_what_the_library_finds(recorded):
    (bag, *_), deviation, _, events = recorded
    assert [e.begins for e in events[:2]] == [True, False]
    found = [
        (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, bool(m.status[0].level))
        for _, m in messages(bag, '/estimator/event')
    ]
    assert found == [(e.stamp, e.begins) for e in events]
    (curves,) = read_curves(bag, None, '/plant')
    np.testing.assert_array_equal(curves.deviation, deviation)
    assert curves.events[0] == (events[0].since, events[1].stamp)


def test_tables_say_at_each_sample_whether_an_event_lasts(recorded):
    (_, csv, npz), deviation, lasts, _ = recorded
    with np.load(npz) as found:
        of_npz = {name: found[name] for name in found.files}
    np.testing.assert_array_equal(of_npz['event'], lasts)
    np.testing.assert_array_equal(of_npz['std_unknown_input'], deviation[:, 1])
    of_csv = np.genfromtxt(csv, delimiter=',', names=True)
    np.testing.assert_array_equal(of_csv['event'], lasts)
    np.testing.assert_array_equal(of_csv['std_z1'], deviation[:, 0])


def test_the_figure_shows_band_and_events(recorded, tmp_path, monkeypatch):
    (bag, *_), _, _, events = recorded
    bands, shaded = [], []
    monkeypatch.setattr('matplotlib.axes.Axes.fill_between', lambda *a, **_: bands.append(a))
    monkeypatch.setattr('matplotlib.axes.Axes.axvspan', lambda *a, **_: shaded.append(a[1:]))
    assert plot.main([str(bag), '-o', str(tmp_path / 'figure.svg')]) == 0
    assert len(bands) == 2  # of z1 and of d
    first = (events[0].since - files.ORIGIN) * 1e-9
    assert min(begin for begin, _ in shaded) == pytest.approx(first, abs=0.02)
