# SPDX-License-Identifier: Apache-2.0
"""Plant and estimator as two processes; the estimator alone against a replay of its samples."""

import bisect
import math
import signal

from fhaosmo_ros.core.observer.estimates import TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from rig import EstimatorRig, node_process, parameters, Process  # noqa: E402
from std_msgs.msg import Float64, Float64MultiArray  # noqa: E402

RATE = 50.0


@pytest.fixture(scope='module')
def pair(client, start):
    """Plant and estimator that have run until a hundred estimates came."""
    start('plant', *parameters(sample_rate=500.0))
    start('estimator', *parameters(publish_rate=RATE))
    rig = EstimatorRig(client, feed=False)
    truth = (
        client.record('/plant/state', Float64MultiArray),
        client.record('/plant/unknown_input', Float64),
    )
    client.wait(lambda: truth[0] and truth[1], 'truth of the plant')
    client.wait(lambda: len(rig.topics['stamp']) >= 5 * RATE, 'estimates')
    return rig, truth


def test_rate_is_the_timers(pair):
    rig, _ = pair
    for topic, messages in rig.topics.items():

        def at_rate(messages=messages) -> bool:
            stamps = [m.stamp for m in messages[-100:]]
            return np.median(np.diff(stamps)) * 1e-9 == pytest.approx(1.0 / RATE, rel=0.1)

        rig.client.wait(at_rate, f'{topic} at {RATE} Hz')


def test_state_is_labelled_and_sized(pair):
    rig, truth = pair
    for messages in (rig.topics['state'], truth[0]):
        message = messages[-1].message
        (dimension,) = message.layout.dim
        assert (dimension.label, dimension.size, dimension.stride) == ('z1,z2,z3', 3, 3)
        assert len(message.data) == 3
        assert message.layout.data_offset == 0
    innovation = rig.topics['innovation'][-1].message
    assert innovation.layout.dim[0].label == 'eps1,eps2,eps3,eps4'
    assert len(innovation.data) == 4


def test_stamp_is_a_samples_source_stamp(pair):
    rig, _ = pair
    ours = [m.stamp for m in list(rig.y)]
    stamps = [e.stamp for e in rig.estimates if ours[0] <= e.stamp <= ours[-1]]
    assert len(stamps) > RATE
    assert set(stamps) <= set(ours)
    assert stamps == sorted(stamps)


def test_estimates_are_finite_and_close(pair):
    rig, (states, inputs) = pair
    low = ESTIMATOR_PARAMETERS['gamma_min'].default
    high = ESTIMATOR_PARAMETERS['gamma_max'].default

    def rms_of_a_second() -> np.ndarray:
        last = rig.estimates[-int(RATE) :]
        estimates = np.array([[*e.z, e.unknown_input] for e in last])
        truth = np.array([
            [*nearest(states, e.stamp).data, nearest(inputs, e.stamp).data] for e in last
        ])  # fmt: skip
        return np.sqrt(np.mean((estimates - truth) ** 2, axis=0))

    # A machine that stalls makes a gap, and the observer starts afresh: then it has a second more.
    rig.client.wait(
        lambda: (rms_of_a_second() < [0.005, 0.05, 0.1, 0.05]).all(), 'estimates near the truth'
    )
    for e in rig.estimates:
        assert all(map(math.isfinite, [*e.z, e.unknown_input, e.gamma, *e.innovation]))
        assert low <= e.gamma <= high


def nearest(messages: list, stamp: int):
    """Return the message that was published nearest to a time."""
    after = bisect.bisect([m.stamp for m in messages], stamp)
    return min(messages[max(after - 1, 0) :][:2], key=lambda m: abs(m.stamp - stamp)).message


@pytest.mark.parametrize(
    ('namespace', 'options'),
    [
        ('/plain', {}),
        ('/paper', {'variant': 'sign', 'scheme': 'explicit', 'estimate_from': 'filtered'}),
        ('/input', {'order': 2, 'phi': "['u', '-z2 + sin(z1)']", 'lambda': '[15.0, 10.0, 5.0]'}),
    ],
)
def test_equals_a_replay_of_the_same_samples(client, folder, namespace, options):
    arguments = parameters(namespace=namespace, publish_rate=500.0, max_gap=60.0, **options)
    with node_process(folder(), 'estimator', *arguments):
        rig = EstimatorRig(client, namespace)
        replay = OnlineEstimator(
            {'max_gap': 60.0}
            | options
            | ({'phi': ['u', '-z2 + sin(z1)'], 'lambda': [15, 10, 5]} if 'phi' in options else {})
        )
        for k in range(100):
            estimate = rig.feed(0.2 + 0.1 * math.sin(0.1 * k))
            expected = replay.update(estimate.stamp, rig.y[-1].message.data)
            for name in ('z', 'unknown_input', 'gamma', 'innovation'):
                np.testing.assert_allclose(
                    getattr(estimate, name), getattr(expected, name), rtol=0.0, atol=1e-12
                )
        # A burst, faster than the timer: every sample counts, whichever estimates are published.
        burst = [(rig.send(0.2 + 0.001 * k), 0.2 + 0.001 * k) for k in range(100)]
        rig.wait_estimate(lambda e: e.stamp == burst[-1][0], 'estimate of the last sample')
        expected = {stamp: replay.update(stamp, y) for stamp, y in burst}
        compared = [e for e in rig.estimates if e.stamp in expected]
        assert compared[-1].stamp == burst[-1][0]
        for e in compared:
            np.testing.assert_allclose(e.z, expected[e.stamp].z, rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(
                e.unknown_input, expected[e.stamp].unknown_input, rtol=0.0, atol=1e-12
            )


def test_tuning_is_that_of_a_replay(client, folder):
    # With a nominal period no sample is unlikely because it was sent late, and so rejected.
    even = {'sampling': 'nominal', 'nominal_period': 0.01}
    settings = {'gains': 'self_tuning', 'max_gap': 60.0, **even}
    arguments = parameters(namespace='/tuned', publish_on='sample', **settings)
    with node_process(folder(), 'estimator', *arguments):
        found = client.record('/tuned/estimator/tuning', Float64MultiArray)
        rig = EstimatorRig(client, '/tuned', gains='self_tuning')
        replay = OnlineEstimator(settings)
        client.wait(lambda: client.node.count_publishers('/tuned/estimator/tuning'), 'tuning')
        rig.feed(0.2)  # no sample from before the reset is on its way any more
        rig.reset()
        for noise in np.random.default_rng(1).normal(0.0, 1e-3, 80):
            estimate = rig.feed(0.2 + noise)
            replay.update(estimate.stamp, rig.y[-1].message.data)
        noise, correlation, bandwidth, shares = replay.observer.tuning
        assert bandwidth > 0.0
        expected = [noise, correlation, bandwidth, *shares]
        client.wait(lambda: found and list(found[-1].message.data) == expected, 'same tuning')
        assert found[-1].message.layout.dim[0].label == ','.join(TUNING)


FALLBACK = """
import sys
from fhaosmo_ros.nodes.estimator import node as estimator
from fhaosmo_ros.nodes.middleware import spin

spin.EventsExecutor = None  # an older rclpy
sys.exit(estimator.main(sys.argv[1:]))
"""


def test_without_the_events_executor_it_works_too(client, folder):
    arguments = parameters(namespace='/older', publish_rate=200.0, max_gap=60.0)
    process = Process(folder(), *arguments, code=FALLBACK)
    try:
        rig = EstimatorRig(client, '/older')
        for y in (0.2, 0.21, 0.22):
            estimate = rig.feed(y)
        assert abs(estimate.z[0] - 0.22) < 0.1
        process.send(signal.SIGINT)
        assert process.wait() == 0, process.output
        assert 'Traceback' not in process.output
    finally:
        process.kill()
