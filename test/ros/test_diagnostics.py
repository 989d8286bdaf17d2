# SPDX-License-Identifier: Apache-2.0
"""Reports on /diagnostics: their values, and what makes them WARN, ERROR and STALE."""

import itertools
import math
from pathlib import Path
from types import SimpleNamespace

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from builtin_interfaces.msg import Time  # noqa: E402
from fhaosmo_ros.core.online.estimator import OnlineEstimator  # noqa: E402
from fhaosmo_ros.core.parameters.files import load  # noqa: E402
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS  # noqa: E402
from fhaosmo_ros.nodes.estimator.health import Health  # noqa: E402
from fhaosmo_ros.nodes.middleware.publisher_watch import Publishers  # noqa: E402
import numpy as np  # noqa: E402
from rig import EstimatorRig, node_process, Parameters, parameters  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402

OK, WARN, ERROR, STALE = b'\0', b'\1', b'\2', b'\3'
RATE = 200.0
LAX = {'warn_jitter_above': 1e6, 'warn_delay_above': 1e6, 'diagnostics_period': 0.2}
"""A loaded machine is no reason for a warning here."""


@pytest.fixture(scope='module')
def rig(client, start):
    """An estimator that hears a plant."""
    start('plant', *parameters(namespace='/d', sample_rate=RATE))
    start('estimator', *parameters(namespace='/d', **LAX))
    rig = EstimatorRig(client, '/d', feed=False)
    rig.wait_status('input', OK, 'OK')
    return rig


def numbers(status) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_names_are_those_that_ros_tools_expect(rig):
    rig.client.wait(lambda: rig.diagnostics, 'diagnostics')
    statuses = [
        s for m in rig.diagnostics for s in m.message.status if s.name.startswith('d/estimator')
    ]
    assert {s.name for s in statuses} == {
        'd/estimator: state', 'd/estimator: input', 'd/estimator: observer',
    }  # fmt: skip
    assert {s.hardware_id for s in statuses} == {'none'}
    assert all(s.message for s in statuses)
    assert all(len({pair.key for pair in s.values}) == len(s.values) for s in statuses)


def test_values_of_the_input(rig):
    def as_sampled() -> bool:  # over 0.2 s, in which a loaded machine may stall
        values.update(numbers(rig.wait_status('input', OK)))
        return float(values['sample rate [Hz]']) == pytest.approx(RATE, rel=0.2)

    values = {}
    rig.client.wait(as_sampled, 'rate of the plant')
    assert values['topic'] == '/d/y'
    assert values['publishers'] == '/d/plant'
    assert float(values['jitter (std / mean of the period)']) >= 0.0
    mean = 1.0 / float(values['sample rate [Hz]'])
    assert float(values['longest period [s]']) >= 0.999 * mean
    assert 0.0 < float(values['longest delay [s]']) < 10.0
    assert 0.0 <= float(values['age of the last sample [s]']) < 10.0
    assert int(values['samples accepted']) > 0
    assert int(values['samples lost']) >= 0


def test_values_of_the_observer(rig):
    values = numbers(rig.wait_status('observer', OK))
    assert values['open levels'] == '4 of 4'
    assert 0.1 <= float(values['gamma']) <= 1.0
    assert values['gamma at'] == 'neither bound'
    assert math.isfinite(float(values['unknown input']))
    assert float(values['chatter of the unknown input']) >= 0.0
    assert 0.0 <= float(values['chatter index (0 smooth, 1 nothing but chatter)']) <= 1.0
    assert 0.0 < float(values['step time, mean [us]']) <= float(values['step time, longest [us]'])
    assert int(values['overruns']) >= 0


def test_counters_grow_from_one_report_to_the_next(rig):
    before = int(numbers(rig.wait_status('input', OK))['samples accepted'])
    assert int(numbers(rig.wait_status('input', OK))['samples accepted']) > before


@pytest.mark.parametrize(
    ('task', 'changes', 'words'),
    [
        ('input', {'warn_rate_below': 1e4}, ['sample rate']),
        ('input', {'warn_jitter_above': 0.0}, ['jitter']),
        ('input', {'warn_delay_above': 0.0}, ['after their stamps']),
        ('observer', {'warn_chatter_above': 1e-30}, ['chatters by']),
        ('observer', {'epsilon': 1e-12}, ['levels from 2 on hold', 'epsilon']),
    ],
    ids=str,
)
def test_thresholds(rig, task, changes, words):
    was = {name: rig.parameters.get(name) for name in changes}
    assert rig.parameters.set_atomically(**changes).successful
    rig.wait_status(task, WARN, *words)
    assert rig.parameters.set_atomically(**was).successful
    rig.wait_status(task, OK, 'OK')


def test_hardware_id_and_period_are_live(rig):
    assert rig.parameters.set(hardware_id='encoder 7')[0].successful
    rig.client.wait(
        lambda: rig.wait_status('state', OK).hardware_id == 'encoder 7', 'new hardware_id'
    )
    assert rig.parameters.set(diagnostics_period=2.0)[0].successful
    first = len(rig.diagnostics)

    def slow() -> bool:  # a report that comes late makes the time to the next one shorter
        stamps = [
            m.stamp
            for m in rig.diagnostics[first:]
            if m.message.status[0].name == 'd/estimator: state'
        ]
        return len(stamps) > 2 and stamps[-1] - stamps[-2] > 1.5e9

    rig.client.wait(slow, 'reports 2 s apart')
    assert rig.parameters.set_atomically(hardware_id='none', diagnostics_period=0.2).successful


def test_gamma_at_a_bound_is_said(rig):
    bounds = {'gamma_min': 0.3, 'gamma_initial': 0.3, 'gamma_max': 0.3}
    was = {name: rig.parameters.get(name) for name in bounds}
    assert rig.parameters.set_atomically(**bounds).successful
    rig.client.wait(
        lambda: numbers(rig.wait_status('observer', OK))['gamma at'].startswith('gamma_m'), 'bound'
    )
    assert rig.parameters.set_atomically(**was).successful
    assert rig.parameters.set(variant='sign')[0].successful
    rig.client.wait(
        lambda: numbers(rig.wait_status('observer', OK))['gamma at'] == 'a fixed value', 'it'
    )
    assert rig.parameters.set(variant='fuzzy_adaptive')[0].successful


def test_a_forgotten_freeze_is_said(rig):
    for data, word in ((True, 'the value that ~/freeze holds'), (False, 'neither bound')):
        rig.client.call('/d/estimator/freeze', SetBool, SetBool.Request(data=data))
        rig.client.wait(
            lambda word=word: numbers(rig.wait_status('observer', OK))['gamma at'] == word, word
        )


def test_silence_is_stale(client, folder):
    arguments = parameters(namespace='/e', **LAX)
    with node_process(folder(), 'estimator', *arguments):
        with node_process(folder(), 'plant', *parameters(namespace='/e')):
            rig = EstimatorRig(client, '/e', feed=False)
            rig.wait_status('observer', OK)
        status = rig.wait_status('input', STALE, 'no usable sample for', 'no publisher of /e/y')
        assert numbers(status)['publishers'] == 'none'
        rig.wait_status('observer', STALE, 'no usable samples')


def test_share_of_bad_samples_makes_an_error(client, start):
    limits = {'max_gap': 60.0, 'error_bad_share_above': 0.1}
    start('estimator', *parameters(namespace='/f', **limits, **LAX))
    rig = EstimatorRig(client, '/f')
    rig.feed(0.2)
    for level, share in ((ERROR, 0.1), (WARN, 1.0)):
        assert rig.parameters.set(error_bad_share_above=share)[0].successful
        start_at = len(rig.diagnostics)

        def said(level=level, start_at=start_at) -> bool:
            rig.send(math.nan)  # until a report has no good sample of before
            return any(
                s.name == 'f/estimator: input' and s.level == level
                and 'rejected measurements' in s.message
                for published in rig.diagnostics[start_at:] for s in published.message.status
            )  # fmt: skip

        client.wait(said, f'level {level}')


def test_a_clock_that_does_not_run_is_said(client, start):
    process = start(
        'estimator', *parameters(namespace='/g', use_sim_time='true', sampling='clock', **LAX)
    )
    rig = EstimatorRig(client, '/g', feed=False)
    rig.wait_status('state', ERROR, 'nothing on /clock')
    publish = client.publisher('/clock', Clock)
    ticks = itertools.count(1)

    def runs() -> bool:
        publish(Clock(clock=Time(sec=next(ticks))))
        return any(s.message == 'active' for s in rig.statuses())

    client.wait(runs, 'clock that runs')
    rig.wait_status('state', WARN, 'the time on /clock stands still for', 'paused')
    publish.destroy()
    rig.wait_status('state', ERROR, 'stands still', 'nobody publishes it any more')
    assert process.output.count('stands still') == 1  # once, not five times a second


def test_missing_known_input_is_said(client, start):
    start('estimator', *parameters(namespace='/h', phi="['0', '0', 'u']", **LAX))
    rig = EstimatorRig(client, '/h', feed=False)
    rig.wait_status('input', STALE, 'no publisher of u')
    assert Parameters(client, '/h/estimator').get('phi') == ['0', '0', 'u']


def test_simulation_time_samples_by_the_clock_unless_it_is_told_otherwise(client, start):
    for given, expected in (({}, 'clock'), ({'sampling': 'nominal'}, 'nominal')):
        namespace = f'/sim_{expected}'
        start('estimator', *parameters(namespace=namespace, use_sim_time='true', **given))
        values = Parameters(client, f'{namespace}/estimator')
        assert values.get('sampling') == expected


@pytest.mark.parametrize(('samples', 'told'), [(25, 'ticks once for 25 samples'), (1, '')])
def test_a_clock_that_is_slower_than_the_samples_is_said(samples, told):
    """What `ros2 bag play --clock` gives, at 40 Hz, and a clock that ticks with every sample."""
    estimator = OnlineEstimator({'sampling': 'clock'})
    health = Health(estimator, ESTIMATOR_PARAMETERS.complete(LAX))
    source = SimpleNamespace(topic='/y', message_type='std_msgs/msg/Float64')
    y = SimpleNamespace(source=source, field=None, stamps='source', error='', lacking=0, why='')
    for begin in (1000, 2000):  # the first report is on the first tick too
        for k in range(begin, begin + 1000):
            estimator.update(k // samples * samples * 1_000_000, 0.2)
        report, _ = health.reports(y, Publishers({(1,): '/plant'}, {}), stale=False, name='')
    status = report.message('estimator', 'none')
    assert told in status.message
    assert status.level == (WARN if told else OK)


def noise_1e_3() -> dict:
    path = Path(__file__).resolve().parents[2] / 'config' / 'noise_1e-3.yaml'
    return load(path, 'estimator', ONLINE_PARAMETERS)


@pytest.mark.parametrize(
    ('period', 'noise', 'jump', 'told'),
    [
        (1, 1e-3, 0.0, ''),
        (2, 1e-3, 0.0, 'gains are for 1000 Hz, y comes at 500 Hz'),
        (1, 1e-2, 0.0, 'times as large as noise_size says'),
        (1, 1e-3, 1.0, 'y jumped 1 times'),
    ],
    ids=['nothing', 'rate', 'noise', 'jump'],
)  # fmt: skip
def test_what_no_longer_fits_is_said(period, noise, jump, told):
    estimator = OnlineEstimator(noise_1e_3())
    health = Health(estimator, ESTIMATOR_PARAMETERS.complete(LAX | {'warn_chatter_above': 1e9}))
    source = SimpleNamespace(topic='/y', message_type='std_msgs/msg/Float64')
    y = SimpleNamespace(source=source, field=None, stamps='source', error='', lacking=0, why='')
    rng = np.random.default_rng(1)
    for k in range(1, 3000):
        stamp = k * period * 1_000_000
        estimator.update(stamp, noise * rng.standard_normal() + jump * (k > 2000))
        health.stamps.append(stamp)
    _, report = health.reports(y, Publishers({(1,): '/plant'}, {}), stale=False, name='')
    status = report.message('estimator', 'none')
    assert told in status.message
    assert status.level == (WARN if told else OK)
