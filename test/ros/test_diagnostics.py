# SPDX-License-Identifier: Apache-2.0
"""Reports on /diagnostics: their values, and what makes them WARN, ERROR and STALE; QoS."""

from functools import partial

from builtin_interfaces.msg import Time
from fhaosmo_ros.nodes.recording import PrivateNode
import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from running import ERROR, FED, joint_state, LATCHED, LAX, OK, Parameters, STALE, values_of, WARN
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Int64

RATE = 200.0
"""Of the pair's plant."""
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_values_of_the_reports(pair):
    def as_sampled(values) -> bool:  # a loaded machine may stall, or not know a new node's name
        near = float(values['sample rate [Hz]']) == pytest.approx(RATE, rel=0.2)
        return near and values['publishers'] == '/pair/plant'

    found = pair.wait_values('input', as_sampled, 'rate and name of the plant')
    observer = values_of(pair.wait_status('observer', OK, 'OK'))
    assert not {'nan', 'inf'} & {*found.values(), *observer.values()}
    assert (found['topic'], observer['open levels']) == ('/pair/y', '4 of 4')
    assert float(found['longest period [s]']) >= 0.999 / float(found['sample rate [Hz]'])
    assert 0.0 < float(found['longest delay [s]']) < 60.0
    mean, longest = (float(observer[f'step time, {x} [us]']) for x in ('mean', 'longest'))
    assert 0.0 < mean <= longest
    assert 0.0 <= float(observer['chatter index (0 smooth, 1 nothing but chatter)']) <= 1.0
    accepted = int(found['samples accepted'])
    pair.wait_values('input', lambda v: int(v['samples accepted']) > accepted, 'more samples')
    assert set(pair.reports[-1].statuses) == {'state', 'input', 'observer'}


@pytest.mark.parametrize(
    ('task', 'changes', 'words'),
    [
        ('input', {'warn_rate_below': 1e4}, ['sample rate']),
        ('input', {'warn_jitter_above': 0.0}, ['jitter']),
        ('input', {'warn_delay_above': 0.0}, ['after their stamps']),
        ('observer', {'epsilon': 1e-12}, ['levels from 2 on hold', 'epsilon']),
    ],
    ids=str,
)
def test_thresholds(pair, task, changes, words):
    was = pair.parameters.all(changes)
    pair.parameters.set(**changes)
    pair.wait_status(task, WARN, *words)
    pair.parameters.set(**was)
    pair.wait_status(task, OK, 'OK')


def test_hardware_id_and_period_are_live(pair):
    assert pair.reports[-1].statuses['state'].hardware_id == 'none'
    pair.parameters.set(hardware_id='encoder 7', diagnostics_period=0.5)
    since = len(pair.reports)

    def slow() -> bool:  # a report that comes late makes the time to the next one shorter
        stamps = [report.stamp for report in pair.reports[since:]]
        return len(stamps) > 2 and stamps[-1] - stamps[-2] > 0.4e9

    pair.user.wait(slow, 'reports 0.5 s apart')
    assert pair.reports[-1].statuses['state'].hardware_id == 'encoder 7'
    pair.parameters.set(hardware_id='none', diagnostics_period=LAX['diagnostics_period'])


def test_what_no_longer_fits_is_said(user, estimator):
    file = ['--params-file', 'config/noise_1e-3.yaml']
    options = LAX | {'publish_on': 'sample', 'max_gap': 60.0}
    options |= {'input_topic': 'q', 'input_field': 'position[a]', 'reliable': ['q']}
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

    def wait_said(words: str, fresh: bool = True, **samples) -> None:
        if fresh:
            assert rig.reset().success
        rig.wait_status('observer', WARN, words, doing=partial(send, **samples))

    for _ in range(10):
        send()
    said = ' '.join(report.statuses['observer'].message for report in rig.reports)
    assert not [words for words in ('jumped', 'as large as', 'gains are for') if words in said]
    wait_said('y jumped 1 times', fresh=False, offset=1.0)
    wait_said('times as large as noise_size says', noise=1e-2)
    wait_said('gains are for 1000 Hz, y comes at 500 Hz', period=2)


# Publishers that can't be heard, or are too many.


@pytest.fixture
def stranger():
    """A node beside the user, as another process would have."""
    private = PrivateNode('stranger')  # not spun: a destroyed publisher is gone at once
    yield private.node
    private.node.destroy_node()
    private.node.context.try_shutdown()


def test_publishers_are_named(user, estimator, stranger):
    rig = estimator('/heard', **FED)
    rig.wait_status('input', STALE, 'no usable sample yet', 'no publisher of /heard/y')
    rig.wait_said('still waiting', 'no publisher of /heard/y')
    assert values_of(rig.reports[-1].statuses['input'])['publishers'] == 'none'

    unheard = stranger.create_publisher(Float64, '/heard/y', BEST_EFFORT)
    policy = 'qos_overrides./heard/y.subscription'
    words = ('/stranger', 'best effort publisher and reliable subscription', policy)
    for _ in range(2):
        rig.wait_status('input', ERROR, *words)
    assert len(rig.said('/stranger publishes /heard/y unheard')) == 1  # once, not with each report
    stranger.destroy_publisher(unheard)
    rig.wait_status('input', STALE, 'no publisher')

    unheard = stranger.create_publisher(Int64, '/heard/y', 10)
    rig.wait_status('input', ERROR, '/stranger', 'std_msgs/msg/Int64', 'std_msgs/msg/Float64')
    stranger.destroy_publisher(unheard)

    first = stranger.create_publisher(Float64, '/heard/y', 10_000)
    rig.wait_values('input', lambda v: v['publishers'] == '/stranger', 'name of the publisher')
    rig.listen()
    rig.wait_status('input', STALE, '2 publishers')
    rig.wait_said('2 publishers of')
    user.wait(lambda: first.get_subscription_count() >= 2, 'subscription of the first')
    for _ in range(20):
        first.publish(Float64(data=0.2))
    rig.wait_count('samples accepted', 20)
    for _ in range(5):  # numbered from 1 on, below those of the first: nothing is lost
        rig.send(0.2)
        first.publish(Float64(data=0.2))
    rig.wait_count('samples accepted', 30)
    assert rig.count('samples lost') == 0
    stranger.destroy_publisher(first)
    rig.wait_values('input', lambda v: v['publishers'] == '/user', 'one publisher')


def test_what_was_published_before_is_heard_if_asked_for(estimator, stranger):
    before = stranger.create_publisher(Float64, '/latched/y', LATCHED)
    before.publish(Float64(data=2.5))
    durability = {'qos_overrides./latched/y.subscription.durability': 'transient_local'}
    rig = estimator('/latched', **FED | {'publish_on': 'timer'} | durability)
    assert rig.wait_estimate(lambda e: True, 'estimate of the latched sample').z[0] == 2.5
    stranger.create_publisher(Float64, '/latched/y', 10)
    rig.wait_status('input', WARN, '/stranger', 'volatile', 'qos_overrides./latched/y')


# Policies of what is published.


def policies(user, topic: str):
    user.wait(lambda: user.node.count_publishers(topic), f'publisher of {topic}')
    return user.node.get_publishers_info_by_topic(topic)[0].qos_profile


def test_policies_of_estimates(user, launch):
    """An estimate that nobody listens to is not made, unless its publisher keeps the last ones."""
    node = '/out/estimator'
    prefix = f'qos_overrides.{node}'
    launch('estimator', namespace='/out', gains='self_tuning', reliable=['y'], **FED, **{
        f'{prefix}/state.publisher.reliability': 'best_effort',
        f'{prefix}/unknown_input.publisher.durability': 'transient_local',
        f'{prefix}/standard_deviation.publisher.depth': 7,
    })  # fmt: skip
    parameters = Parameters(user, node)
    assert parameters.get(f'{prefix}/standard_deviation.publisher.depth') == 7
    assert parameters.get(f'{prefix}/innovation.publisher.depth') == 1000

    reliable, kept = (policies(user, f'{node}/{topic}') for topic in ('stamp', 'unknown_input'))
    assert policies(user, f'{node}/state').reliability == ReliabilityPolicy.BEST_EFFORT
    assert reliable.reliability == ReliabilityPolicy.RELIABLE
    assert reliable.durability == DurabilityPolicy.VOLATILE
    assert kept.durability == DurabilityPolicy.TRANSIENT_LOCAL

    y, reports = user.publisher('/out/y'), user.reports[node[1:]]

    def used() -> bool:
        y.publish(Float64(data=0.5))
        values = values_of(reports[-1].statuses['input']) if reports else {}
        return int(values.get('samples accepted', 0)) > 0

    user.wait(used, 'accepted samples')
    before = reports[-1].stamp
    kept = user.record(f'{node}/unknown_input', Float64, LATCHED)
    fresh = user.record(f'{node}/stamp', Time)
    user.wait(lambda: y.publish(Float64(data=0.5)) or (kept and len(fresh) > 10), 'estimates')
    assert kept[0].stamp < before < fresh[0].stamp
