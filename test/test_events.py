# SPDX-License-Identifier: Apache-2.0
"""Events: what begins and ends one, by every way of running, in bags, in tables and in figures."""

import bag_files as files
from fhaosmo_ros.core import EventDetector, OnlineEstimator
from fhaosmo_ros.core.observer.estimates import TUNING
from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.tools import plot
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.plot import read_curves
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
from observer_cases import states_of
import pytest

H = 10**6
BEGIN = 1_700_000_000 * 10**9


def found(d, deviations=None, words=None, **parameters):
    """Return the events in estimates of d at 1 kHz, as (sample, begins)."""
    detector = EventDetector(parameters)
    stamps = BEGIN + H * np.arange(len(d))
    detector.take(stamps, d, deviations, words=words)
    events = detector.taken()
    for event in events:
        assert event.stamp == stamps[event.sample]
        assert words is not None or event.begins == (abs(event.value) > event.limit)
    for one, other in zip(events[::2], events[1::2], strict=False):
        assert one.since == other.since <= one.stamp
        assert one.begins > other.begins
    return [(event.sample, event.begins) for event in events]


def pulse(begin, end, count=1000, height=1.0):
    d = np.zeros(count)
    d[begin:end] = height
    return d


def events_at(*samples):
    return [(sample, k % 2 == 0) for k, sample in enumerate(samples)]


ONE, ONCE = pulse(300, 600), events_at(350, 600)
DENT = pulse(100, 500) - pulse(200, 210, height=0.6)
SPIKES = pulse(400, 420, height=Status.REJECTED_SPIKE).astype(int)
RESTART = SPIKES + pulse(500, 501, height=Status.RESTARTED).astype(int)


@pytest.mark.parametrize(('d', 'own', 'events'), [
    (-ONE, {}, ONCE),
    (ONE, {'event_duration': 0.0}, events_at(300, 600)),
    (ONE, {'event_threshold': 1.0}, []),  # not more than that
    (ONE, {'event_duration': 0.3}, []),
    # What lasts for less counts from its own begin.
    (pulse(100, 140) + pulse(141, 180) + pulse(200, 300), {}, events_at(250, 300)),
    # Hysteresis keeps an event together.
    (DENT, {'event_threshold': 0.7}, events_at(150, 500)),
    (DENT, {'event_threshold': 0.9}, events_at(150, 200, 260, 500)),
    # Rejected samples do not count, and a restart ends an event.
    (ONE - pulse(400, 420), {'words': SPIKES}, ONCE),
    (ONE - pulse(400, 420), {'words': RESTART}, events_at(350, 500, 551, 600)),
    # Threshold and deviations both have to be exceeded.
    *((ONE, {'deviations': np.full(1000, 0.1), 'event_deviations': k, 'event_threshold': limit},
       events) for k, limit, events in ((4.0, 0.7, ONCE), (4.0, 1.1, []), (11.0, 0.1, []))),
    # A deviation that is not known yet.
    (ONE, {'deviations': 0.1 + pulse(0, 400, height=np.inf), 'event_deviations': 4.0},
     events_at(450, 600)),
])  # fmt: skip
def test_an_event_lasts_from_the_least_duration_to_the_release(d, own, events):
    assert found(d, **{'event_threshold': 0.5, **own}) == events


def test_a_standard_deviation_that_grows_with_the_event_does_not_hide_it():
    deviations = np.full(1000, 0.1)
    deviations[300:] = 1.0
    for height, later in ((3.9, []), (4.1, [(750, True)])):
        d = pulse(300, 600) + pulse(700, 1000, height=height)
        begin, (end, _), *others = found(d, deviations, event_deviations=4.0)
        assert begin == (350, True)
        # Half of 0.4 * 10^(1 - e^(-k / 200)) is 1 after 240 samples.
        assert end == pytest.approx(540, abs=3)
        # From the end of an event on it counts as it is.
        assert others == later


def test_a_change_is_judged_against_the_running_mean():
    d = 5.0 + pulse(1000, 4000, 6000) + 1e-3 * np.sin(np.arange(6000))
    own = {'event_threshold': 0.5, 'event_change_time': 0.8}
    events = found(d, **own)
    # 0.8 ln 4 = 1.1 s after a step of 1 the mean has followed it but for the release of 1/4.
    expected = [1050, 1000 + 800 * np.log(4.0), 4050, 4000 + 800 * np.log(4.0)]
    np.testing.assert_allclose([k for k, _ in events], expected, atol=60)
    # Nothing is judged before the mean is known.
    assert found(5.0 + pulse(0, 400), **own) == []


MODEL = {'order': 1, 'phi': ['-z1']}
FIXED = {
    'structure': 'levant', 'scheme': 'predict_correct', 'variant': 'fuzzy', 'lambda': [4.0, 5.0],
    'noise_size': 1e-3, 'correction_period': 0.01, 'fuzzy_widths': [0.1],
}  # fmt: skip
CASES = {
    'fixed': MODEL | FIXED | {'event_threshold': 0.5},
    'change': MODEL | FIXED | {'event_threshold': 0.4, 'event_change_time': 2.0},
    'self-tuning': MODEL | {'gains': 'self_tuning', 'event_deviations': 5.0},
}


@pytest.fixture(scope='module')
def samples():
    """y of z1' = -z1 + d at 100 Hz with outliers and a gap, d = 1 from 10 s to 16 s."""
    t = 0.01 * np.arange(2400)
    y = states_of(np.array([[-1.0]]), (t > 10.0) & (t < 16.0), period=0.01)[:, 0]
    y += 1e-3 * np.random.default_rng(4).standard_normal(len(t))
    t[2000:] += 0.7
    y[[400, 1250, 1251]] += 5.0
    y[700] = np.nan
    return BEGIN + (1e9 * t).astype(np.int64), y


@pytest.mark.parametrize('case', CASES)
def test_an_event_is_found_and_nothing_else(samples, case):
    estimator = OnlineEstimator(CASES[case])
    estimator.run(*samples)
    begins = [(e.stamp - BEGIN) * 1e-9 for e in estimator.events.taken() if e.begins]
    assert len([t for t in begins if 10.0 < t < 11.0]) == 1
    assert not [t for t in begins if t < 10.0]


def test_a_reset_ends_an_event_and_so_does_switching_off(samples):
    stamps, y = samples
    estimator = OnlineEstimator(CASES['fixed'])
    estimator.run(stamps[:1100], y[:1100])
    estimator.reset()
    estimator.run(stamps[1100:1101], y[1100:1101])
    assert [e.begins for e in estimator.events.taken()] == [True, False]
    estimator.run(stamps[1101:1400], y[1101:1400])
    assert estimator.events.active
    estimator.configure({'event_threshold': 0.0})
    assert not estimator.events.active
    estimator.run(stamps[1400:], y[1400:])
    assert [e.begins for e in estimator.events.taken()] == [True, False]


def test_bag_tables_and_figure_have_what_the_node_finds(samples, tmp_path, monkeypatch):
    """To the last bit; `found` has tuning, whether an event lasts, and standard deviations."""
    (stamps, y), own = (values[:1900] for values in samples), CASES['self-tuning']
    recorded = files.write(tmp_path / 'bag', files.floats(stamps, y))
    bag, csv, npz = (tmp_path / name for name in ('out', 'out.csv', 'out.npz'))
    words = [word for output in (bag, csv, npz) for word in ('-o', str(output))]
    words += [word for name, value in own.items() for word in ('-p', f'{name}:={value}')]
    assert replay.main([str(recorded), *words]) == 0
    estimator, found = OnlineEstimator(own), []
    for stamp, value in zip(stamps.tolist(), y.tolist(), strict=True):
        if not estimator.update(stamp, value).status.rejected:
            tuning = np.hstack(estimator.observer.tuning)
            found.append([*tuning, estimator.events.active, *estimator.standard_deviation])
    found, events = np.array(found), estimator.events.taken()
    assert [e.begins for e in events[:2]] == [True, False]
    with BagReader(bag) as reader:
        of_bag = reader.samples('/estimator/tuning')
        _, _, message, _ = next(reader.objects(['/estimator/tuning']))
    assert message.layout.dim[0].label.split(',') == TUNING
    np.testing.assert_array_equal(of_bag.values, found[:, :7])
    of_csv = np.genfromtxt(csv, delimiter=',', names=True)
    names = [*(f'tuning_{name}' for name in TUNING), 'event', 'std_z1', 'std_unknown_input']
    with np.load(npz) as of_npz:
        for name, column in zip(names, found.T, strict=True):
            np.testing.assert_array_equal(of_npz[name], column)
            np.testing.assert_array_equal(of_csv[name], column)
    with BagReader(bag) as reader:
        told = [
            (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, bool(m.status[0].level))
            for _, _, m in reader.read_all(['/estimator/event'])
        ]
    assert told == [(e.stamp, e.begins) for e in events]
    (curves,) = read_curves(bag, [], '/plant')
    np.testing.assert_array_equal(curves.deviation, found[:, 8:])
    assert curves.events[0] == (events[0].since, events[1].stamp)
    bands, shaded = [], []
    monkeypatch.setattr('matplotlib.axes.Axes.fill_between', lambda *a, **_: bands.append(a))
    monkeypatch.setattr('matplotlib.axes.Axes.axvspan', lambda *a, **_: shaded.append(a[1:]))
    assert plot.main([str(bag), '-o', str(tmp_path / 'figure.svg')]) == 0
    assert len(bands) == 2  # of z1 and of d
    first = (events[0].since - BEGIN) * 1e-9
    assert min(begin for begin, _ in shaded) == pytest.approx(first, abs=0.02)
