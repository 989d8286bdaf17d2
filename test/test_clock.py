# SPDX-License-Identifier: Apache-2.0
"""sampling: clock: times of samples by a clock that stands still between its ticks."""

from fhaosmo_ros.core import OnlineEstimator
import numpy as np
import pytest

MS = 1_000_000
START = 100 * 10**9


def sample(k):
    return 0.2 + 0.1 * np.sin(0.01 * k)


def times_by(readings):
    """Return the times of samples that came when the clock read so; 0 before there is one."""
    estimator = OnlineEstimator({'sampling': 'clock'})
    found = []
    for k, reading in enumerate(readings.tolist()):
        estimator.update(reading, sample(k))
        found.append(estimator.stamp or 0)
    assert estimator.counters.restarts == estimator.counters.backward_stamps == 0
    return np.array(found), estimator


TRUE = START + MS * np.arange(10_000)
SLOW = START + MS * (np.arange(10_000) // 25 * 25)
"""Times at 1 kHz, and what a clock of 40 Hz reads then."""


def clock_readings(published, lateness, seed):
    """
    Return what a clock on /clock reads when each sample comes.

    The time is published 20 µs before every 25th sample; messages of both are late by a
    half-normal time of this scale (s), and what is late holds up what was published after it.
    """
    rng = np.random.default_rng(seed)

    def received(times):
        late = 1e9 * lateness * np.abs(rng.standard_normal(len(times)))
        return np.maximum.accumulate(times + late.astype(np.int64))

    ticks = published[::25]
    latest = np.searchsorted(received(ticks - 20_000), received(published), side='right')
    return ticks[np.maximum(latest, 1) - 1]


@pytest.mark.parametrize('late', [0.0, 1e-5, 1e-4, 1e-3])
def test_late_ticks_and_samples_hardly_move_the_times(late):
    for seed in range(3):
        times = times_by(clock_readings(TRUE, late, seed))[0][5000:]
        assert np.diff(times) == pytest.approx(MS, rel=0.002)
        assert times == pytest.approx(TRUE[5000:], abs=MS)


def test_clock_that_ticks_slower_than_samples_come_spreads_them():
    """1 kHz on a clock of 40 Hz, heard late: from the third tick on as if it had true stamps."""
    times, ticked = times_by(np.where(np.arange(10_000) < 50, 0, SLOW))
    true = OnlineEstimator()
    true.run(TRUE[50:], [sample(k) for k in range(50, len(TRUE))])
    assert np.abs(times - TRUE)[150:].max() <= 13 * MS
    assert ticked.period == pytest.approx(1e-3, rel=0.1)
    np.testing.assert_allclose(ticked.estimate.z, true.estimate.z, atol=0.05)
    assert ticked.counters.spread_stamps > 9300
    assert ticked.counters.far_stamps == 0


@pytest.mark.parametrize('reading', [5090, 5005], ids=['ticks first', 'samples first'])
def test_node_that_stands_for_a_moment_moves_no_times(reading):
    """For 90 ms; then what has come is taken at once."""
    readings = SLOW.copy()
    readings[5005:5095] = SLOW[reading]
    assert np.diff(times_by(readings)[0][2000:]) == pytest.approx(MS, rel=0.002)


@pytest.mark.parametrize('tick', [1, 25])
def test_times_of_a_sensor_that_is_not_steady_are_those_of_the_clock(tick):
    """Its samples are no line; each time is right within two ticks and two samples."""
    intervals = np.random.default_rng(0).exponential(2 * MS, 8000).astype(np.int64)
    true = START + np.cumsum(np.maximum(intervals, 1000))
    times, _ = times_by(true // (tick * MS) * (tick * MS))
    assert np.median(np.abs(times - true)[4000:]) < 2 * (tick + 2) * MS


def test_samples_are_back_at_the_clock_after_a_gap():
    times, _ = times_by(np.delete(SLOW, np.s_[5005:5405]))
    assert times[5005] == pytest.approx(TRUE[5405], abs=30 * MS)
    assert times[5500:] == pytest.approx(TRUE[5900:], abs=30 * MS)


def test_clock_that_stands_still_is_two_samples_ahead_of_its_next_tick_at_most():
    times, estimator = times_by(START + MS * np.repeat([0, 10, 20], [5, 5, 1005]))  # paused
    assert times[-1] <= START + (30 + 2 * 2) * MS  # 2 ms between samples
    assert not estimator.update(START + 30 * MS, 0.2).status.rejected


@pytest.mark.parametrize('together', [25, 1])
def test_samples_of_a_clock_that_jumps_back_restart_within_one_tick(together):
    estimator = OnlineEstimator({'sampling': 'clock'})
    for begin, count in ((START, 500), (10 * MS, 50)):
        for k in range(count):
            estimator.update(begin + k // together * together * MS, sample(k))
    counters = estimator.counters
    assert counters.restarts_backward == counters.restarts == 1
    assert 0 < estimator.stamp < 100 * MS


def read_in_bursts(period: float, preempted: float):
    """
    Return stamps of TRUE's samples by a driver that reads a buffer each so many ms, late.

    At a share of the reads, and of the samples, it waits for about half a period more.
    """
    random, count = np.random.default_rng(3), len(TRUE)
    late = np.abs(random.normal(0.0, 5e4, count)).astype(np.int64)
    hangs = (random.random((2, count)) < [[preempted], [preempted / period]]).astype(np.int64)
    hangs *= random.exponential(0.5 * period * MS, (2, count)).astype(np.int64)
    reads = TRUE[0] + np.cumsum(hangs[0] + round(period * MS)) - round(period * MS) + late
    burst = np.searchsorted(reads, TRUE)
    stamps = reads[burst] + 5000 * (np.arange(count) - np.searchsorted(burst, burst))
    return np.maximum.accumulate(stamps + hangs[1]) + np.arange(count)


@pytest.mark.parametrize(
    ('period', 'preempted'), [(2, 0.0), (7.3, 0.0), (16, 0.0), (7.3, 0.3), (16, 0.3)]
)
def test_samples_that_a_driver_reads_in_bursts_lie_on_a_line(period, preempted):
    estimator, times = OnlineEstimator(), []
    stamps, y = read_in_bursts(period, preempted), sample(np.arange(len(TRUE)))
    for stamp, value in zip(stamps.tolist(), y.tolist(), strict=True):
        estimator.update(stamp, value)
        times.append(estimator.stamp)
    assert (OnlineEstimator().run(stamps, y).t == times).all()
    assert np.diff(times)[3000:] == pytest.approx(MS, rel=0.002)
    assert times[3000:] == pytest.approx(TRUE[3000:], abs=MS)
    assert estimator.counters.spread_stamps > 0.9 * (1.0 - 1.0 / period) * len(TRUE)


@pytest.mark.parametrize('noise', [0.0, 1e-4])
def test_samples_that_are_taken_in_bursts_keep_their_stamps(noise):
    k = np.arange(5000)
    stamps = START + MS * (k // 10 * 10) + 5000 * (k % 10)
    estimator = OnlineEstimator()
    y = 0.2 + 0.1 * np.sin(1e-8 * (stamps - START))
    estimator.run(stamps, y + noise * np.random.default_rng(0).standard_normal(5000))
    assert estimator.counters.spread_stamps == 0
