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
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

MS = 1_000_000


def test_bad_samples_are_rejected_and_counted_and_many_are_an_error(fed):
    rejected = fed.count('rejected measurements')
    fed.feed(0.2)
    stamps = [fed.send(y) for y in (math.nan, math.inf, -math.inf)]
    after = fed.feed(0.21)
    fed.wait_count('rejected measurements', rejected + 3)
    assert not {e.stamp for e in fed.estimates} & set(stamps)
    assert all(map(math.isfinite, [*after.z, after.unknown_input, after.gamma]))
    assert abs(after.z[0] - 0.2) < 0.1
    assert fed.said('rejected a sample: expected a finite y of at most 1e60, got nan')
    # Until a report has no good sample of before.
    fed.wait_status('input', ERROR, 'rejected measurements', doing=lambda: fed.send(math.nan))


def test_what_holds_gamma_is_said_and_freeze_lets_it_go(fed):
    def wait_word(word: str) -> None:
        fed.feed(0.2)
        fed.wait_values('observer', lambda v: v['gamma at'].startswith(word), f'gamma at {word}')

    def freeze(data: bool) -> str:
        return fed.user.call(f'{fed.name}/freeze', SetBool, SetBool.Request(data=data)).message

    wait_word('neither bound')
    fed.parameters.set(gamma_rate=100.0, gamma_initial=0.6, gamma_dead_zone=0.0)
    fed.reset()
    before = [fed.feed(0.2 + 0.1 * math.sin(k)) for k in range(12)][-1]
    assert freeze(True) == 'gamma is held'
    held = [fed.feed(0.2 + 0.1 * math.sin(k)).gamma for k in range(20)]
    assert held == [before.gamma] * 20
    wait_word('the value that ~/freeze holds')
    assert freeze(False) == 'gamma adapts again'
    assert fed.feed(0.5).gamma != before.gamma
    fed.parameters.set(gamma_min=0.3, gamma_initial=0.3, gamma_max=0.3)
    wait_word('gamma_m')
    fed.parameters.set(variant='sign')
    wait_word('a fixed value')


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


def test_slow_sensor_does_not_flood_the_log(estimator):
    """Each sample is a jump of the stamps: said at most every 5 s of each kind, with a count."""
    begin = time.monotonic()
    rig = estimator('/flood', **LAX, max_gap=0.001).listen()
    for k in itertools.count():
        rig.send(math.nan if k % 10 == 5 else 1.0)
        if rig.count('restarts') >= 20 and rig.count('rejected measurements') >= 2:
            break
        assert time.monotonic() < begin + 60.0
        time.sleep(0.003)
    kinds = [re.sub(r'[-\d.e+]+', '0', line) for line in rig.said('[WARN]')]
    most = 2 + (time.monotonic() - begin) // 5.0
    for kind in set(kinds):
        assert kinds.count(kind) <= most, kind
    for words in ('restarted from the new one', 'restarts so far)', 'no usable sample', 'got nan'):
        rig.wait_said(words)


def test_bad_inputs_are_rejected_and_the_last_one_is_held(user, estimator):
    model = {'order': 2, 'phi': ['0', 'u - z2'], 'max_gap': 60.0}
    rig = estimator('/bad_u', reliable=['y', 'u'], **FED | model)
    rig.wait_status('input', STALE, 'no publisher of u')
    rig.listen()
    u = user.publisher('/bad_u/u')
    for value in (1.0, math.nan, math.inf):
        u.publish(Float64(data=value))
    rig.wait_count('rejected inputs', 2)
    replay = OnlineEstimator(model)
    replay.set_input(1.0)
    for y in (0.2, 0.21, 0.23):
        estimate = rig.feed(y)
        assert estimate.z == list(replay.update(estimate.stamp, y).z)
    assert rig.said('rejected u = nan: expected a finite number; the last one is held')


# Clocks.


@pytest.fixture
def clock(user):
    """Return a function that publishes a time on /clock until a condition holds."""
    publisher = user.node.create_publisher(Clock, '/clock', 10)

    def publish(now: int, condition, step: int = 0) -> None:
        ticks = itertools.count(now, step)

        def holds() -> bool:
            publisher.publish(Clock(clock=as_time(next(ticks))))
            return condition()

        user.wait(holds, f'effect of {now} ns on /clock')

    publish.end = lambda: user.node.destroy_publisher(publisher)
    yield publish
    publish.end()


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
    assert not any('ticks once' in r.statuses['input'].message for r in rig.reports)
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
        clock(next(ticks), lambda: True)
        for _ in range(25):
            rig.send(2.0)

    rig.wait_status('input', WARN, 'ticks once for', doing=send)


def test_a_clock_that_does_not_run_is_said_and_negative_time_is_rejected(clock, estimator, launch):
    plant = launch('plant', namespace='/still', use_sim_time=True)
    rig = estimator('/still', use_sim_time=True, **LAX)
    assert rig.parameters.get('sampling') == 'clock'
    for process in (plant, rig.process):
        clock(-5 * SECOND, lambda process=process: 'seconds >= 0, got -5' in process.output())
    assert plant.poll() is None
    rig.wait_status('state', ERROR, 'nothing on /clock')
    clock(SECOND, lambda: rig.reports[-1].statuses['state'].message == 'active', SECOND)
