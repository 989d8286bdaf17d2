# SPDX-License-Identifier: Apache-2.0
"""Bad samples, gaps, jumps of time, and clocks that do not run: survived, counted and said."""

import itertools
import math
import re
import time

from fhaosmo_ros.core.online.estimator import OnlineEstimator
import pytest
from rosgraph_msgs.msg import Clock
from running import as_time, ERROR, FED, LAX, SECOND, STALE, WARN
from std_srvs.srv import SetBool

MS = 1_000_000


def test_bad_samples_are_rejected_and_counted_and_many_are_an_error(fed):
    rejected = fed.count('rejected measurements')
    before = fed.feed(0.2)
    for y in (math.nan, math.inf, -math.inf):
        fed.send(y)
    after = fed.feed(0.21)
    fed.wait_count('rejected measurements', rejected + 3)
    assert fed.estimates[-2:] == [before, after]  # and nothing was published between them
    assert all(map(math.isfinite, [*after.z, after.unknown_input, after.gamma]))
    assert abs(after.z[0] - 0.2) < 0.1
    assert fed.said('rejected a sample: expected a finite y of at most 1e60, got nan')
    # Until a report has no good sample of before.
    fed.wait_status('input', ERROR, 'rejected measurements', doing=lambda: fed.send(math.nan))


def test_freeze_holds_gamma_and_lets_it_go(fed):
    def freeze(data: bool) -> str:
        return fed.user.call(f'{fed.name}/freeze', SetBool, SetBool.Request(data=data)).message

    fed.parameters.set(gamma_rate=100.0, gamma_initial=0.6, gamma_dead_zone=0.0)
    fed.reset()
    before = [fed.feed(0.2 + 0.1 * math.sin(k)) for k in range(12)][-1]
    assert freeze(True) == 'gamma is held'
    held = [fed.feed(0.2 + 0.1 * math.sin(k)).gamma for k in range(20)]
    assert held == [before.gamma] * 20
    fed.wait_values('observer', lambda values: values['gamma is held'] == 'True', 'held gamma')
    assert freeze(False) == 'gamma adapts again'
    assert fed.feed(0.5).gamma != before.gamma


def test_gap_stops_the_output_and_restarts_the_observer(fed):
    fed.parameters.set(max_gap=1.0, publish_on='timer')
    before = fed.count('restarts')
    fed.feed(0.2)
    fed.wait_said('for 1 s: not publishing until one comes')
    fed.wait_status('input', STALE, 'no usable sample for')
    # The timer is silent now: over the next reports nothing comes.
    ticks = len(fed.topics['stamp'])
    for _ in range(3):
        fed.wait_status('input', STALE)
    assert len(fed.topics['stamp']) <= ticks + 1  # one may have been on its way
    fed.send(4.0)  # held: one stamp far away may be wrong
    assert fed.feed(4.0).z == [4.0, 0.0, 0.0]
    fed.wait_count('restarts', before + 1)
    assert fed.said('restarted from the new one')


def test_each_kind_of_fault_is_said_at_most_every_five_seconds(fed):
    """Each sample is a jump of the stamps, or no number."""
    begin, said = time.monotonic(), len(fed.said('[WARN]'))
    restarts, rejected = fed.count('restarts'), fed.count('rejected measurements')
    fed.parameters.set(max_gap=1e-6)
    for _ in range(20):
        fed.send(1.0)
        fed.send(math.nan)
    fed.wait_count('restarts', restarts + 5)
    fed.wait_count('rejected measurements', rejected + 20)
    kinds = [re.sub(r'[-\d.e+]+', '0', line) for line in fed.said('[WARN]')[said:]]
    most = 2 + (time.monotonic() - begin) // 5.0
    assert max(map(kinds.count, kinds), default=0) <= most
    assert fed.said('restarted from the new one', 'restarts so far)')


# Clocks.


@pytest.fixture
def clock(user):
    """Return a function that publishes a time on /clock until a condition holds."""
    publisher = user.node.create_publisher(Clock, '/clock', 10)

    def publish(now: int, condition=lambda: True) -> None:
        message = Clock(clock=as_time(now))
        user.wait(lambda: publisher.publish(message) or condition(), f'effect of {now} ns')

    yield publish
    user.node.destroy_publisher(publisher)


def test_node_clock_sampling_follows_simulated_time(clock, estimator):
    rig = estimator('/sim', **FED | LAX, use_sim_time=True, sampling='clock')
    rig.listen()
    replay = OnlineEstimator({'max_gap': 60.0})

    def at(now: int, y: float) -> None:
        """Send a sample once a report has this time, which has then arrived."""
        clock(now, lambda: rig.reports and rig.reports[-1].time == now)
        rig.send(y)

    for k in range(10):
        now, y = 100 * SECOND + 10 * MS * k, 0.2 + 0.1 * math.sin(0.1 * k)
        at(now, y)
        estimate = rig.wait_estimate(lambda e, now=now: e.stamp == now, 'estimate')
        assert estimate.z == list(replay.update(now, y).z)
    # Time jumps far back, as a bag that is played again makes it.
    at(5 * SECOND, 2.0)  # held: one stamp far away may be wrong
    rig.wait_count('far stamps', 1)
    at(5 * SECOND + 10 * MS, 2.0)
    estimate = rig.wait_estimate(lambda e: e.stamp < 50 * SECOND, 'estimate in the new time')
    assert estimate.z == [2.0, 0.0, 0.0]
    assert rig.said('restarted from the new one')
    # /clock is slower than the samples, as `ros2 bag play --clock` makes it, at 40 Hz.
    ticks = itertools.count(6 * SECOND, 25 * MS)

    def send() -> None:
        clock(next(ticks))
        for _ in range(25):
            rig.send(2.0)

    rig.wait_status('input', WARN, 'ticks once for', doing=send)


def test_a_clock_that_does_not_run_is_said_and_negative_time_is_rejected(clock, estimator, launch):
    plant = launch('plant', namespace='/still', use_sim_time=True)
    rig = estimator('/still', use_sim_time=True, **LAX)
    assert rig.parameters.get('sampling') == 'clock'
    for process in (plant, rig.process):
        clock(-5 * SECOND, lambda process=process: 'seconds >= 0, got -5' in process.output())
    rig.wait_status('state', ERROR, 'nothing on /clock')
    clock(SECOND, lambda: rig.reports[-1].statuses['state'].message == 'active')
