# SPDX-License-Identifier: Apache-2.0
"""Every live parameter, set through the node's services, changes what the estimator does."""

import math
from typing import NamedTuple

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS
import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from rig import EstimatorRig, parameters  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402

FIRST, SECOND = 12, 40
"""Samples before and after the change."""
QUICK_GAMMA = {'gamma_rate': 100.0, 'gamma_initial': 0.6}
EVEN = {'sampling': 'nominal', 'nominal_period': 0.01}
DEFAULTS = {
    name: p.default for name, p in ONLINE_PARAMETERS.items() if p.live
} | {'max_gap': 60.0, 'divergence_time': 0.0} | EVEN  # fmt: skip
"""With a nominal period, what a change does is independent of how fast samples are sent."""


class Case(NamedTuple):
    """
    What to set, and what shows it.

    Attributes
    ----------
    value : object
        New value.
    context : dict
        Other parameters from the start on.
    prepare : dict
        Parameters set just before, with and without the change.
    reset : bool
        The change acts on the next start.
    y : callable
        Sample by its number, after the change.

    """

    value: object
    context: dict = {}  # noqa: RUF012
    prepare: dict = {}  # noqa: RUF012
    reset: bool = False
    y: object = None


PREDICTING = {'structure': 'levant', 'scheme': 'predict_correct'}
PREDICTING |= {'lambda': [8.0, 20.0, 30.0, 16.0], 'fuzzy_widths': [1.0]}
CASES = {
    'unknown_input_decay': Case(500.0),
    'structure': Case('levant'),
    'variant': Case('sign'),
    'scheme': Case('explicit'),
    'lambda': Case([100.0]),
    'alpha': Case([300.0]),
    'epsilon': Case(1e-9),
    'fuzzy_widths': Case([0.01, 0.02]),
    'fuzzy_systems': Case(['curve 0 0.8 1']),
    'gamma_initial': Case(0.5, reset=True),
    'gamma_rate': Case(500.0, QUICK_GAMMA),
    'gamma_min': Case(0.6, {'gamma_initial': 0.5}, prepare={'gamma_initial': 0.6}),
    'gamma_max': Case(0.5, {'gamma_initial': 0.7}, prepare={'gamma_initial': 0.5}),
    'gamma_dead_zone': Case(1e6, QUICK_GAMMA),
    'gamma_leakage': Case(
        1e3, {'gamma_initial': 0.7, 'gamma_dead_zone': 0.0}, prepare={'gamma_initial': 0.5}
    ),
    'initial_estimate': Case([0.5], reset=True),
    'initial_internal': Case([0.5], reset=True),
    'start_from_measurement': Case(False, reset=True),
    'estimate_from': Case('filtered'),
    'sampling': Case('nominal', {'sampling': 'source_stamp', 'nominal_period': 0.05}),
    'nominal_period': Case(0.05),
    'max_step': Case(2e-4),
    'spike_gate': Case(1e-6),
    'stuck_time': Case(1e-6, y=lambda _: 0.2),
    'divergence_time': Case(1e-6, {'epsilon': 1e-9}),
    'divergence_limit': Case(1.0, y=lambda k: 1.5 + 0.01 * k),
}
ELSEWHERE = {
    'max_gap', 'publish_rate', 'diagnostics_period', 'hardware_id', 'warn_rate_below',
    'warn_jitter_above', 'warn_delay_above', 'warn_chatter_above', 'error_bad_share_above',
    'predict_to_now',  # needs a delay, which is fixed: test_delay.py
    # These act where y is far off or its rate changes: test_online_parameters.py.
    'correction_period', 'noise_size', 'state_sizes', 'unknown_input_size', 'unknown_input_rate',
    'bandwidth', 'tuning_memory',
    # These decide what is an event: test_event_topic.py, test_online_parameters.py.
    'event_threshold', 'event_deviations', 'event_duration', 'event_release',
    'event_change_time',
    'publish_on', 'measurement_unit', 'unknown_input_unit', 'unknown_input_scale',
    'prediction_step',  # between samples this close it moves the last digits only: test_levant.py
}  # fmt: skip
"""Tested below, in test_parameters.py, test_diagnostics.py and test_messages.py."""


def test_no_live_parameter_is_left_out():
    assert set(CASES) | ELSEWHERE == {n for n, p in ESTIMATOR_PARAMETERS.items() if p.live}


@pytest.fixture(scope='module')
def rig(client, start):
    process = start('estimator', *parameters(publish_rate=200.0, max_gap=60.0))
    rig = EstimatorRig(client)
    rig.process = process
    return rig


def wave(k: int) -> float:
    return 0.2 + 0.1 * math.sin(0.7 * k)


@pytest.mark.parametrize('name', CASES)
def test_change_acts_as_in_a_replay_and_differs_from_none(rig, name):
    case = CASES[name]
    values = DEFAULTS | case.context
    result = rig.parameters.set_atomically(**values)
    assert result.successful, result.reason
    rig.reset()
    with_change, without = OnlineEstimator(values), OnlineEstimator(values)
    samples = [(rig.send(wave(k)), wave(k)) for k in range(FIRST)]
    if case.prepare:
        assert rig.parameters.set_atomically(**case.prepare).successful
    (result,) = rig.parameters.set(**{name: case.value})
    assert result.successful, result.reason
    if case.reset:
        rig.reset()
    y = case.y or wave
    samples += [(rig.send(y(k)), y(k)) for k in range(FIRST, FIRST + SECOND)]

    for estimator, changes in ((with_change, {name: case.value}), (without, {})):
        for sample in samples[:FIRST]:
            estimator.update(*sample)
        estimator.configure(case.prepare | changes)
        if case.reset:
            estimator.reset()
        for sample in samples[FIRST:]:
            estimator.update(*sample)
    expected, other = with_change.estimate, without.estimate
    found = rig.wait_estimate(lambda e: e.stamp == with_change.stamp, 'last estimate')
    for ours, theirs in (
        (found.z, expected.z), (found.innovation, expected.innovation),
        (found.unknown_input, expected.unknown_input), (found.gamma, expected.gamma),
    ):  # fmt: skip
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    same = np.allclose(
        [*expected.z, expected.unknown_input, expected.gamma],
        [*other.z, other.unknown_input, other.gamma], rtol=1e-6, atol=1e-9,
    )  # fmt: skip
    assert with_change.stamp != without.stamp or not same


def test_max_gap_acts_on_the_next_silence(rig):
    assert rig.parameters.set_atomically(**DEFAULTS).successful
    assert rig.parameters.set(max_gap=0.123)[0].successful
    rig.feed(0.2)
    rig.client.wait(
        lambda: 'for 0.123 s: not publishing until one comes' in rig.process.output, 'silence'
    )


def test_freeze_holds_gamma_and_lets_it_go(rig):
    no_rest = QUICK_GAMMA | {'gamma_dead_zone': 0.0}
    assert rig.parameters.set_atomically(**(DEFAULTS | no_rest)).successful
    rig.reset()
    for k in range(FIRST):
        before = rig.feed(wave(k))
    freeze = '/estimator/freeze'
    answer = rig.client.call(freeze, SetBool, SetBool.Request(data=True))
    assert answer.success
    assert answer.message == 'gamma is held'
    held = [rig.feed(wave(k)).gamma for k in range(SECOND)]
    assert held == [before.gamma] * SECOND
    answer = rig.client.call(freeze, SetBool, SetBool.Request(data=False))
    assert answer.message == 'gamma adapts again'
    assert rig.feed(wave(3)).gamma != before.gamma


def test_seed_by_parameters_and_reset(rig):
    seed = {'start_from_measurement': False, 'initial_estimate': [0.1, 0.0, 0.0, 0.0],
            'initial_internal': [0.2, 0.3, 0.4, 0.0]}  # fmt: skip
    assert rig.parameters.set_atomically(**(DEFAULTS | seed)).successful
    assert rig.reset().success
    estimate = rig.feed(0.1)
    assert estimate.z == [0.1, 0.2, 0.3]
    assert estimate.unknown_input == 0.4
