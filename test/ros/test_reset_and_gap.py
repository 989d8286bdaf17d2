# SPDX-License-Identifier: Apache-2.0
"""Faults of time at the node: resets, gaps, a clock that jumps back."""

import contextlib
import math
import time

from fhaosmo_ros.core.online.estimator import OnlineEstimator
import numpy as np
import pytest

MS = 1_000_000

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from rig import DEADLINE, Estimate, EstimatorRig, node_process, parameters  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402


@pytest.fixture(scope='module')
def rig(client, start):
    process = start('estimator', *parameters(publish_rate=200.0, max_gap=3.0))
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
    rig.wait_status('input', b'\3', 'no usable sample for')
    assert 'not publishing until' in rig.process.output
    # The timer is silent now: over the next two diagnostics, a second apart, nothing comes.
    reports, ticks = len(rig.diagnostics), len(rig.topics['stamp'])
    rig.client.wait(lambda: len(rig.diagnostics) >= reports + 2, 'diagnostics')
    assert len(rig.topics['stamp']) <= ticks + 1  # one may have been on its way
    rig.send(4.0)  # held: one stamp far away may be wrong
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
            if time.monotonic() > end:
                raise TimeoutError(f'no {what}')
            self.now += step
            seconds, nanoseconds = divmod(self.now, 10**9)
            self._publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
            with contextlib.suppress(TimeoutError):
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
        namespace='/sim', use_sim_time='true', sampling='clock', publish_rate=100.0, max_gap=60.0
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
        replay = OnlineEstimator({'max_gap': 60.0})
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
        rig.send(2.0)  # held: one stamp far away may be wrong
        assert simulated.feed(2.0).z == [2.0, 0.0, 0.0]
        assert 'restarted from the new one' in process.output


@pytest.mark.parametrize('name', ['estimator', 'plant'])
def test_negative_time_on_clock_is_rejected(client, folder, name):
    clock = client.publisher('/clock', Clock)
    arguments = parameters(namespace=f'/negative_{name}', use_sim_time='true')
    with node_process(folder(), name, *arguments) as process:
        client.wait(lambda: clock.matched() >= 1, 'subscription of /clock')

        def told() -> bool:
            clock(Clock(clock=Time(sec=-5)))
            return 'expected seconds >= 0, got -5' in process.output

        client.wait(told, 'warning')
        assert process.running
    clock.destroy()


def test_stamps_that_jump_all_the_time_do_not_flood_the_log(client, folder):
    """Each pair of samples is a restart; it is said at most every 5 s, with a count."""
    arguments = parameters(namespace='/flood', max_gap=0.001)
    with node_process(folder(), 'estimator', *arguments) as process:
        rig = EstimatorRig(client, '/flood', greet=False)
        begin = time.monotonic()

        def restarted() -> bool:
            rig.send(1.0)
            return rig.count('restarts') >= 20

        client.wait(restarted, '20 restarts')
        said = process.output.count('restarted from the new one')
        assert 1 <= said <= 1 + (time.monotonic() - begin) // 5.0
        assert 'restarts so far)' in process.output
