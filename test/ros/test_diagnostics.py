# SPDX-License-Identifier: Apache-2.0
"""Reports on /diagnostics; bad samples, gaps, clocks and QoS: survived, counted and said."""

from functools import partial
import itertools
import math
import re
import signal
import time

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.nodes.recording import PrivateNode
import numpy as np
import pytest
from rclpy.qos import ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from running import as_time, ERROR, FED, joint_state, LATCHED, OK, SECOND, STALE, WARN
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Int64, String

RATE = 200.0
"""Of the pair's plant."""


def test_values_of_the_reports(pair):
    def as_sampled(values) -> bool:  # a loaded machine may stall, or not know a new node's name
        near = float(values['sample rate [Hz]']) == pytest.approx(RATE, rel=0.2)
        return near and values['publishers'] == '/pair/plant'

    found = pair.wait_values('input', as_sampled, 'rate and name of the plant')
    observer = pair.wait_status('observer', OK, 'OK')
    assert not {'nan', 'inf'} & {*found.values(), *observer.values()}
    assert (found['topic'], observer['open levels']) == ('/pair/y', '4 of 4')
    assert 0.0 < float(found['longest delay [s]']) < 60.0
    assert float(observer['step time, mean [us]']) > 0.0


@pytest.mark.parametrize(('who', 'words'), [
    ('source', 'sampling to nominal and nominal_period to 0.'), ('process', 'after their stamps'),
])  # fmt: skip
def test_a_process_that_stands_still_for_a_moment_is_told(pair, who, words):
    process = getattr(pair, who)

    def stand_still() -> None:
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        process.send_signal(signal.SIGCONT)

    pair.wait_status('input', WARN, words, doing=stand_still)
    pair.wait_status('input', OK, 'OK')


def test_levels_on_hold_are_told(pair):
    changes = {'epsilon': 1e-12, 'divergence_time': 0.0}
    was = pair.parameters.all(changes)
    pair.parameters.set(**changes)
    pair.wait_status('observer', WARN, 'levels from 2 on hold', 'epsilon')
    pair.parameters.set(**was)
    pair.wait_status('observer', OK, 'OK')


def test_what_no_longer_fits_is_said(user, estimator):
    file = ['--params-file', 'config/noise_1e-3.yaml']
    options = FED | {'input_topic': 'q', 'input_field': 'position[a]', 'reliable': ['q']}
    rig = estimator('/fits', *file, **options)
    q = user.publisher('/fits/q', JointState)
    rng, stamp, sent = np.random.default_rng(1), 0, 0

    def send(period: int = 1, noise: float = 1e-3, offset: float = 0.0) -> None:
        """Send 200 samples, whose stamps are so many ms apart, and wait until they are used."""
        nonlocal stamp, sent
        sent += 200
        for y in noise * rng.standard_normal(200) + offset:
            stamp += period * 1_000_000
            q.publish(joint_state(stamp, ['a'], [y]))
        taken = ('samples accepted', 'samples rejected')
        user.wait(lambda: sum(map(rig.count, taken)) >= sent, 'use of all samples')

    for _ in range(10):
        send()
    said = ' '.join(report.statuses['observer'].message for report in rig.reports)
    assert not [words for words in ('jumped', 'as large as', 'gains are for') if words in said]
    for words, samples in (
        ('y jumped 1 times', {'offset': 1.0}),
        ('times as large as noise_size says', {'noise': 1e-2}),
        ('gains are for 1000 Hz, y comes at 500 Hz', {'period': 2}),
    ):
        rig.wait_status('observer', WARN, words, doing=partial(send, **samples))
        assert rig.reset().success


@pytest.fixture
def stranger():
    """A node beside the user, as another process would have."""
    private = PrivateNode('stranger')  # not spun: a destroyed publisher is gone at once
    yield private.node
    private.node.destroy_node()
    private.node.context.try_shutdown()


def test_publishers_are_named(user, estimator, stranger):
    rig = estimator('/heard', **FED)
    found = rig.wait_status('input', STALE, 'no usable sample yet', 'no publisher of /heard/y')
    assert found['publishers'] == 'none'
    rig.wait_said('[WARN]', 'input: no publisher of /heard/y')

    stranger.create_publisher(String, '/heard/estimator/parameters', 10)
    unheard = stranger.create_publisher(Int64, '/heard/y', 10)
    for _ in range(2):
        rig.wait_status('state', WARN, 'active; 2 nodes have this name, their estimates mix')
        rig.wait_status('input', ERROR, '/stranger', 'std_msgs/msg/Int64', 'std_msgs/msg/Float64')
    stranger.destroy_publisher(unheard)
    rig.wait_status('input', STALE, 'no publisher')

    first = stranger.create_publisher(Float64, '/heard/y', 10_000)
    rig.wait_values('input', lambda v: v['publishers'] == '/stranger', 'name of the publisher')
    rig.listen()
    rig.wait_status('input', STALE, '2 publishers', '/stranger')
    user.wait(lambda: first.get_subscription_count() >= 2, 'subscription of the first')
    for k in range(25):  # the stranger's numbers are below our own: nothing is lost
        rig.send(0.2)
        if k >= 20:
            first.publish(Float64(data=0.2))
    rig.wait_count('samples accepted', 30)
    stranger.destroy_publisher(first)
    rig.wait_values('input', lambda v: v['publishers'] == '/user', 'one publisher')
    rig.send(0.2)
    rig.wait_count('samples accepted', 31)
    assert rig.count('samples lost') == 0


def test_policies_that_the_user_chooses(user, estimator, stranger):
    """An estimate that nobody listens to is not made, unless its publisher keeps the last ones."""
    stranger.create_publisher(Float64, '/out/y', LATCHED).publish(Float64(data=2.5))
    node, prefix = '/out/estimator', 'qos_overrides./out/estimator'
    rig = estimator('/out', gains='self_tuning', **FED, **{
        'qos_overrides./out/y.subscription.durability': 'transient_local',
        f'{prefix}/state.publisher.reliability': 'best_effort',
        f'{prefix}/tuning.publisher.durability': 'transient_local',
        f'{prefix}/standard_deviation.publisher.depth': 7,
    })  # fmt: skip
    rig.wait_count('samples accepted', 1)  # what was published before
    for topic, depth in (('standard_deviation', 7), ('tuning', 1000)):
        assert rig.parameters.get(f'{prefix}/{topic}.publisher.depth') == depth
    state, stamp = (
        user.node.get_publishers_info_by_topic(f'{node}/{topic}')[0].qos_profile
        for topic in ('state', 'stamp')
    )
    assert state.reliability == ReliabilityPolicy.BEST_EFFORT
    assert stamp.reliability == ReliabilityPolicy.RELIABLE
    kept = user.record(f'{node}/tuning', Float64MultiArray, LATCHED)
    missed = user.record(f'{node}/standard_deviation', Float64MultiArray)
    user.wait(lambda: kept, 'the estimate of before')
    now = user.node.get_clock().now().nanoseconds
    y = user.publisher('/out/y', qos=LATCHED, heard=2)
    user.wait(lambda: y.publish(Float64(data=2.6)) or missed, 'an estimate')
    assert kept[0].stamp < now < missed[0].stamp
    stranger.create_publisher(Float64, '/out/y', 10)
    rig.wait_said("'/out/y', offering incompatible QoS", 'DURABILITY')


MS = 1_000_000


def test_bad_samples_are_rejected_and_counted_and_many_are_an_error(fed):
    rejected = fed.count('rejected measurements')
    fed.feed(0.2)
    published = len(fed.estimates)
    for y in (math.nan, math.inf, -math.inf):
        fed.send(y)
    after = fed.feed(0.21)
    fed.wait_count('rejected measurements', rejected + 3)
    assert fed.estimates[published:] == [after]  # and nothing between them
    assert all(map(math.isfinite, [*after.z, after.unknown_input, after.gamma]))
    assert abs(after.z[0] - 0.2) < 0.1
    # Until a report has no good sample of before.
    said = 'samples rejected: y was NaN, infinite or beyond 1e60'
    fed.wait_status('input', ERROR, said, doing=lambda: fed.send(math.nan))
    fed.wait_said('input: ', said)


def test_gap_stops_the_output_and_restarts_the_observer(fed):
    fed.parameters.set(max_gap=1.0, publish_on='timer')
    before = fed.count('restarts')
    fed.feed(0.2)
    fed.wait_status('input', STALE, 'no usable sample for')
    fed.wait_said('input: no usable sample for')
    # The timer is silent now: over the next reports nothing comes.
    ticks = len(fed.topics['stamp'])
    for _ in range(3):
        fed.wait_status('input', STALE)
    assert len(fed.topics['stamp']) <= ticks + 1  # one may have been on its way
    fed.send(4.0)  # held: one stamp far away may be wrong
    assert fed.feed(4.0).z == [4.0, 0.0, 0.0]
    fed.wait_count('restarts', before + 1)


def test_what_reports_say_is_logged_at_most_every_five_seconds(fed):
    """Each sample is a jump of the stamps, or no number."""
    begin, said = time.monotonic(), len(fed.said('input: '))
    restarts, rejected = fed.count('restarts'), fed.count('rejected measurements')
    fed.parameters.set(max_gap=1e-6)
    for _ in range(20):
        fed.send(1.0)
        fed.send(math.nan)
    fed.wait_count('restarts', restarts + 5)
    fed.wait_count('rejected measurements', rejected + 20)
    said_so = partial(fed.said, 'input: ', 'restarts: stamps jumped')
    fed.user.wait(lambda: fed.send(1.0) and said_so(), 'line of the log')
    lines = [line.partition('input: ')[2] for line in fed.said('input: ')[said:]]
    kinds = [re.sub(r'[-+.\d]+', '', line) for line in lines]
    assert max(map(kinds.count, kinds), default=0) <= 2 + (time.monotonic() - begin) // 5.0


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
    rig = estimator('/sim', **FED, use_sim_time=True, sampling='clock')
    rig.listen()
    said = 'samples rejected: nothing on /clock yet'
    rig.wait_status('input', STALE, said, doing=lambda: rig.send(0.2))
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
    rig.wait_count('restarts', 1)
    # /clock is slower than the samples, as `ros2 bag play --clock` makes it, at 40 Hz.
    ticks = itertools.count(6 * SECOND, 25 * MS)

    def send() -> None:
        clock(next(ticks))
        for _ in range(25):
            rig.send(2.0)

    rig.wait_status('input', WARN, 'ticks once for', doing=send)
    rig.parameters.set(sampling='source_stamp')
    rig.wait_status('input', WARN, "dt is in the host's time", 'set sampling to clock')
    rig.wait_said('input: ', 'use_sim_time with sampling = source_stamp')


def test_clocks_that_stand_still_go_back_below_zero_or_jump(user, clock, estimator, launch):
    plant = launch('plant', namespace='/still', use_sim_time=True)
    rig = estimator('/still', use_sim_time=True)
    assert rig.parameters.get('sampling') == 'clock'
    for process in (plant, rig.process):
        clock(-5 * SECOND, lambda process=process: 'seconds >= 0, got -5' in process.output())
    rig.wait_status('state', ERROR, 'nothing on /clock')
    clock(SECOND, lambda: rig.reports[-1].statuses['state'].message == 'active')
    # The plant does not simulate through a jump.
    for begin in (2 * SECOND, 10**6 * SECOND):
        count, ticks = len(rig.y), itertools.count(begin, MS)
        user.wait(
            lambda count=count, ticks=ticks: clock(next(ticks)) or len(rig.y) > count + 5, 'y'
        )
    assert 'goes on from where it was' in plant.output()
