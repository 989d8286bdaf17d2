# SPDX-License-Identifier: Apache-2.0
"""Faults of time: resets, gaps, stamps that stand still or go backwards, another clock."""

import contextlib
import itertools
import math
import time

from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.status import Status
import numpy as np
import pytest

MS = 1_000_000
START = 1_700_000_000 * 10**9


def run(estimator: OnlineEstimator, count: int, start: int = START, step: int = MS) -> int:
    """Feed samples of a sine; return the last stamp."""
    for k in range(count):
        estimator.update(start + k * step, 0.2 + 0.1 * math.sin(0.01 * k))
    return start + (count - 1) * step


# The update path itself: stamps that a middleware can't be made to deliver.


def test_duplicate_stamp_is_rejected_and_changes_nothing():
    estimator = OnlineEstimator()
    last = run(estimator, 50)
    before, state = estimator.estimate, estimator.observer.state
    assert estimator.update(last, 5.0).status & Status.REJECTED_PERIOD
    assert estimator.counters.rejected_stamps == 1
    np.testing.assert_array_equal(estimator.estimate.z, before.z)
    np.testing.assert_array_equal(estimator.observer.state.levels, state.levels)


def test_backward_stamp_is_rejected_and_the_next_one_counts_from_the_latest():
    estimator, other = OnlineEstimator(), OnlineEstimator()
    last = run(estimator, 50)
    run(other, 50)
    assert estimator.update(last - 3 * MS, 5.0).status & Status.REJECTED_PERIOD
    np.testing.assert_array_equal(
        estimator.update(last + MS, 0.21).z, other.update(last + MS, 0.21).z
    )
    assert estimator.counters.restarts == 0


@pytest.mark.parametrize('jump', [600 * MS, -600 * MS, 10**18, -(10**18)])
def test_jump_beyond_max_gap_restarts_from_the_new_sample(jump):
    estimator, fresh = OnlineEstimator(), OnlineEstimator()
    last = run(estimator, 50)
    for k, y in enumerate((0.3, 0.31, 0.32)):
        stamp = last + jump + k * MS
        np.testing.assert_array_equal(estimator.update(stamp, y).z, fresh.update(stamp, y).z)
    assert estimator.counters.restarts == 1
    assert estimator.counters.accepted == 53


def test_gap_of_exactly_max_gap_is_stepped_over():
    estimator = OnlineEstimator({'max_gap': 0.3})
    last = run(estimator, 50)
    estimator.update(last + 300 * MS, 0.2)
    assert estimator.counters.restarts == 0


@pytest.mark.parametrize('sampling', ['source_stamp', 'nominal'])
def test_bad_samples_for_longer_than_max_gap_restart_too(sampling):
    estimator = OnlineEstimator({'sampling': sampling, 'max_gap': 0.5})
    fresh = OnlineEstimator({'sampling': sampling})
    last = run(estimator, 50)
    for k in range(1, 2001):
        estimator.update(last + k * MS, math.nan)
    assert estimator.counters.rejected_measurements == 2000
    stamps = (last + 2001 * MS, last + 2002 * MS)
    for stamp in stamps:
        np.testing.assert_array_equal(estimator.update(stamp, 0.5).z, fresh.update(stamp, 0.5).z)
    assert estimator.counters.restarts == 1


def test_time_of_a_few_bad_samples_is_added_to_the_next_step():
    estimator, other = OnlineEstimator(), OnlineEstimator()
    last = run(estimator, 50)
    run(other, 50)
    estimator.update(last + MS, math.nan)
    estimator.update(last + 2 * MS, math.inf)
    np.testing.assert_allclose(
        estimator.update(last + 3 * MS, 0.21).z,
        other.update(last + 3 * MS, 0.21).z,
        rtol=0.0,
        atol=1e-12,
    )


def test_nominal_sampling_ignores_stamps():
    options = {'sampling': 'nominal', 'nominal_period': 0.002}
    nominal, stamped = OnlineEstimator(options), OnlineEstimator()
    for k, wild in enumerate(itertools.islice(itertools.cycle((0, 10**15, -5, 7)), 100)):
        y = 0.2 + 0.1 * math.sin(0.01 * k)
        np.testing.assert_allclose(
            nominal.update(wild, y).z,
            stamped.update(START + k * 2 * MS, y).z,
            rtol=0.0,
            atol=1e-12,
        )
    assert nominal.counters.rejected == nominal.counters.restarts == 0


def test_change_of_clock_takes_the_nominal_period_once():
    estimator = OnlineEstimator()
    other = OnlineEstimator()
    last = run(estimator, 50)
    run(other, 50)
    estimator.forget_stamp()
    for k in range(1, 4):
        np.testing.assert_array_equal(
            estimator.update(k * MS, 0.21).z, other.update(last + k * MS, 0.21).z
        )


# The node.

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from rig import DEADLINE, Estimate, EstimatorRig, node_process, parameters  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402


@pytest.fixture(scope='module')
def rig(client, start):
    process = start('estimator', *parameters(publish_rate=200.0, max_gap=1.0))
    rig = EstimatorRig(client)
    rig.process = process
    return rig


def test_reset_starts_afresh_with_the_next_sample(rig):
    for k in range(20):
        estimate = rig.feed(0.2 + 0.01 * k)
    assert estimate.z[1] != 0.0
    answer = rig.reset()
    assert answer.success
    assert answer.message
    estimate = rig.feed(3.0)
    assert estimate.z == [3.0, 0.0, 0.0]
    assert estimate.unknown_input == 0.0


def test_gap_stops_the_output_and_restarts_the_observer(rig):
    for k in range(20):
        estimate = rig.feed(0.2 + 0.01 * k)
    before = max(rig.count('restarts'), 0)
    rig.client.wait(lambda: 'not publishing until' in rig.process.output, 'end of the estimates')
    # The timer is silent now: over the next two diagnostics, a second apart, nothing comes.
    reports, ticks = len(rig.diagnostics), len(rig.topics['stamp'])
    rig.client.wait(lambda: len(rig.diagnostics) >= reports + 2, 'diagnostics')
    assert len(rig.topics['stamp']) <= ticks + 1  # one may have been on its way
    estimate = rig.feed(4.0)
    assert estimate.z == [4.0, 0.0, 0.0]
    assert rig.feed(4.0).stamp > estimate.stamp
    rig.wait_count('restarts', before + 1)
    assert 'restarted from the new one' in rig.process.output


class SimulatedTime:
    """Moves /clock on until the estimator has answered; its timers run in that time too."""

    def __init__(self, rig: EstimatorRig, publish_clock) -> None:
        self._rig = rig
        self._publish = publish_clock
        self.now = 100 * 10**9

    def until(self, condition, what: str, step: int = 10 * MS) -> None:
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, f'no {what}'
            self.now += step
            seconds, nanoseconds = divmod(self.now, 10**9)
            self._publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
            with contextlib.suppress(AssertionError):
                self._rig.client.wait(condition, what, timeout=0.1)

    def feed(self, y: float) -> Estimate:
        """
        Publish a sample and return the estimate that belongs to it.

        Waits until two ticks have published it: then the node's clock is past the sample's stamp,
        and the next sample can't get the same one.
        """
        rig = self._rig
        before = rig.estimates[-1].stamp if rig.estimates else None
        rig.send(y)
        self.until(
            lambda: (
                rig.estimates
                and rig.estimates[-1].stamp != before
                and rig.estimates[-1].stamp == rig.estimates[-2].stamp
            ),
            'estimate, twice',
        )
        return rig.estimates[-1]


def test_node_clock_sampling_follows_simulated_time(client, folder):
    clock = client.publisher('/clock', Clock)
    arguments = parameters(
        namespace='/sim', use_sim_time='true', sampling='clock', publish_rate=100.0
    )
    with node_process(folder(), 'estimator', *arguments) as process:
        rig = EstimatorRig(client, '/sim', greet=False)
        simulated = SimulatedTime(rig, clock)

        def heard() -> bool:
            rig.send(0.0)
            return bool(rig.estimates)

        simulated.until(heard, 'first estimate')
        rig.reset()
        # Past the last greeting's stamp, so that the next sample's is another one.
        reports = len(rig.diagnostics)
        simulated.until(lambda: len(rig.diagnostics) > reports, 'diagnostics', step=500 * MS)
        replay = OnlineEstimator()
        for k in range(30):
            y = 0.2 + 0.1 * math.sin(0.1 * k)
            estimate = simulated.feed(y)
            assert 100 * 10**9 <= estimate.stamp <= simulated.now
            assert estimate.stamp % (10 * MS) == 0
            np.testing.assert_allclose(
                estimate.z, replay.update(estimate.stamp, y).z, rtol=0.0, atol=1e-12
            )
        # Time jumps far back, as a bag that is played again makes it.
        simulated.now = 5 * 10**9
        simulated.until(
            lambda: any(
                m.message.header.stamp.sec < 50
                for m in rig.diagnostics
                if m.message.header.stamp.sec and 'sim/' in m.message.status[0].name
            ),
            'diagnostics in the new time',
            step=500 * MS,
        )
        assert simulated.feed(2.0).z == [2.0, 0.0, 0.0]
        assert 'restarted from the new one' in process.output
