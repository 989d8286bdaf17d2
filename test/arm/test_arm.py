# SPDX-License-Identifier: Apache-2.0
"""Rigid-body terms, the filters over all joints, and what an arm makes of its samples."""

from dataclasses import replace
import re

import numpy as np
import pytest

pytest.importorskip('pinocchio')

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.arm.bank import Bank
from fhaosmo_ros.core.arm.model import ArmModel, Calibration
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from observer_cases import discrete
from robots import JOINTS, motion, segment, URDF

NOISE, PERIOD = 2e-5, 1e-3  # what an arm is told by default
T = PERIOD * np.arange(4000)
MODEL = ArmModel(URDF)


@pytest.fixture(scope='module')
def free():
    """Return what `Arm.run` takes: times, noisy positions, torques and velocities."""
    t, q, v, torque = motion(MODEL, T)
    return t, q + NOISE * np.random.default_rng(0).standard_normal(q.shape), torque, v


def rms(torques):
    """Of what is estimated after half a second."""
    return np.sqrt(np.nanmean(torques[500:] ** 2))


def test_a_payload_is_weight_at_its_place():
    model, q, rest = ArmModel(URDF), np.array([0.0, np.pi / 2, 0.0]), np.zeros(3)
    model.set_payload([1.5, 0.0, 0.0, 0.4])
    more = model.terms(q, rest).gravity - MODEL.terms(q, rest).gravity  # stretched out along x
    np.testing.assert_allclose(more, [0.0, -1.5 * 9.81 * 0.8, -1.5 * 9.81 * 0.4], atol=1e-9)
    weight = np.array([1.5 * 9.81, 0.0, 0.0, 0.0, 0.0, 0.0])  # the tool's own x points downwards
    np.testing.assert_allclose(model.frame_jacobian(q, 'tool').T @ weight, -more, atol=1e-9)


@pytest.mark.parametrize(('urdf', 'named', 'text'), [
    (URDF.replace('parent link="base"', 'parent link="bse"'), {}, 'expected a URDF, got'),
    ('<robot name="r"><link name="a"/></robot>', {}, 'expected a joint that moves'),
    (URDF.replace('type="revolute"', 'type="floating"', 1), {}, 'moves in 6 directions'),
    (re.sub(r'(mass value|\bi..)="[^"]*"', r'\1="0"', URDF), {}, 'mass'),
    (URDF, {'joints': ['elbo']}, 'joints: expected some of turn, shoulder, elbow, got elbo'),
    (URDF, {'position_noise': [1e-5, 1e-5]}, '1 or 3 numbers'),
    (URDF, {'payload': [-1.0, 0.0, 0.0, 0.0]}, 'mass >= 0'),
    (URDF, {'gravity': [9.81]}, 'three numbers'),
    (URDF, {'calibration_file': '/none.yaml'}, 'calibration_file'),
    (URDF, {'calibration': replace(Calibration.of_urdf(MODEL), joints=('a', 'b', 'c'))},
     'expected the joints turn, shoulder, elbow'),
])  # fmt: skip
def test_what_cannot_be_used_is_refused_in_one_line(urdf, named, text):
    with pytest.raises(ConfigurationError, match=text) as error:
        Arm(urdf, **named)
    assert '\n' not in str(error.value)


def test_mimic_joints_and_grippers_are_left_out_and_joints_may_be_chosen():
    finger = segment('finger', 'tool', 'finger', '1 0 0', 0.0, kind='prismatic')
    second = segment('second', 'tool', 'other', '1 0 0', 0.0, 0.1, 0.1)
    second = second.replace('</joint>', '<mimic joint="finger"/></joint>')
    more = URDF.replace('</robot>', f'{finger}{second}</robot>')
    assert ArmModel(more).joints == JOINTS
    assert ArmModel(more, joints=['shoulder', 'elbow']).joints == ('shoulder', 'elbow')


@pytest.mark.parametrize('urdf', [
    URDF.replace('"turn" type="revolute"', '"turn" type="continuous"'),
    URDF.replace('"turn" type="revolute"', '"turn" type="prismatic"'),
    re.sub('<limit .*?/>', '<limit velocity="0" effort="0"/>', URDF),  # which means none
    re.sub('"(shoulder|elbow)" type="revolute"', r'"\1" type="fixed"', URDF),
], ids=['continuous', 'prismatic', 'no limits', 'one joint'])  # fmt: skip
def test_other_joints_than_revolute_ones_with_limits(urdf):
    arm = Arm(urdf)
    t, q, _, torque = motion(arm.model, T[:1000])
    if 'continuous' in urdf:
        q[:, 0] = np.remainder(q[:, 0] - q[300, 0], 2 * np.pi)  # it passes the seam
    assert np.abs(arm.run(t, q, torque).external_torque[500:]).max() < 2.0
    assert arm.counters == {'used': len(t) - 1}


@pytest.mark.parametrize('measurement', ['position', 'velocity'])
def test_the_first_estimates_are_as_good_as_later_ones(measurement):
    t, q, v, torque = motion(MODEL, 8e-3 * np.arange(100))
    for push, samples in ((0.0, slice(1, None)), (np.array([3.0, -4.0, 0.0]), slice(10, None))):
        found = Arm(URDF, measurement=measurement).run(t, q, torque - push, v)
        assert np.abs(found.external_torque - push)[samples].max() < 0.05


def test_without_noise_one_filter_is_the_kalman_filter():
    """One joint, weights fixed by rates of zero: compare with the textbook recursion."""
    h, w, r, e = 1e-3, 4.0, 1e-8, 0.01
    bank = Bank([w], 1e-9, [1.0], (0.0, 0.0, 0.0), np.array([[e], [r], [0.0]]))
    bank.start(h, np.eye(1), np.zeros(1), 0.0, [1.0])
    x, p = np.zeros(3), np.diag([0.0, 2.0 * r / h**2, w / 2e-9])
    f, q = discrete(np.eye(3, k=1), np.diag([0.0, 0.0, w]), h)
    g = np.array([h * h / 2, h, 0.0])
    q = q + np.outer(g, g) * e
    random, y, one, before = np.random.default_rng(1), 0.0, np.eye(1), 0.0
    for _ in range(50):
        moved, u = 1e-4 * random.standard_normal(), random.standard_normal()
        y += moved
        bank.step(h, one, np.array([moved]), 0.0, np.array([u]), one)
        x, p, before = f @ x + g * 0.5 * (before + u), f @ p @ f.T + q, u
        k = p[:, 0] / (p[0, 0] + r)
        x, p = x + k * (y - x[0]), p - np.outer(k, p[0])
    np.testing.assert_allclose(bank.mean[1:, 0], x[1:], rtol=1e-6)
    np.testing.assert_allclose(bank.mean[0, 0], x[0] - y, atol=1e-12)
    np.testing.assert_allclose(bank.covariance, [[p[2, 2]]], rtol=1e-6)


def test_a_force_that_is_there_at_once_is_not_taken_for_one_that_grows():
    """The first sample of a step of d = 1: its mean over the sample, not half as much again."""
    h, seen = 1e-3, {}
    for onset in (0.0, 0.1):
        rates, tiny, one = (1.0, 1.0, 0.0), np.full((3, 1), 1e-16), np.eye(1)
        bank = Bank([1e-9], 3.0, [1.0], rates, tiny, onset, of_position=False)
        for change in [0.0] * 20 + [h]:
            bank.step(h, one, np.array([change]), 0.0, np.zeros(1), one)
        seen[onset] = float(bank.mean[2, 0])
    assert 1.3 < seen[0.0] < 1.6
    assert abs(seen[0.1] - 1.0) < 0.05


@pytest.mark.parametrize('measurement', ['position', 'velocity'])
def test_errors_are_as_large_as_their_deviations_and_a_contact_does_not_flicker(free, measurement):
    t, q, torque, v = free
    of_velocity, of_torque = np.random.default_rng(10).standard_normal((2, *v.shape))
    push = np.sin(np.pi * np.clip((t - 1.0) / 2.0, 0.0, 1.0))[:, np.newaxis] ** 2 * [3.0, -4.0, 0]
    named = {'velocity_noise': [1e-4], 'false_alarms_per_minute': 60.0}
    arm = Arm(URDF, named, measurement=measurement)
    found = arm.run(t, q, torque - push + 0.3 * of_torque, v + 1e-4 * of_velocity)
    ends = np.flatnonzero(found.contact[:-1] & ~found.contact[1:]) + 1
    assert len(ends) > np.sum(found.log_odds[ends] > arm._threshold) == 0
    away = (np.abs(found.external_torque - push) / found.standard_deviation)[1100:2900]
    assert 0.6 < np.mean(away < 1.0) < 0.76
    assert 0.9 < np.mean(away < 1.96) < 0.98


@pytest.mark.parametrize('measurement', ['position', 'velocity'])
def test_a_push_is_found_told_and_located(free, measurement):
    arm = Arm(URDF, measurement=measurement, velocity_noise=[1e-4])
    pushed = np.zeros((4000, 3))
    pushed[2000:] = 3.0, -4.0, 0.0
    # The motion is the same because the drives hold against the push.
    t, q, torque, v = free
    found = arm.run(t, q, torque - pushed, v)
    np.testing.assert_allclose(found.external_torque[2200:].mean(axis=0), pushed[-1], atol=0.15)
    assert not found.contact[200:2000].any()
    assert found.contact[2200:].mean() > 0.95
    assert found.link[2200:].count('upper') > 0.9 * 1800
    assert rms((found.velocity - v)[1700:]) < 0.03


def test_currents_and_gravity_compensated_effort(free):
    constants, (t, q, torque, v) = [8.0, 4.0, 0.5], free
    gravity = np.array([MODEL.terms(*row).gravity for row in zip(q, v, strict=True)])
    expected = Arm(URDF).run(*free).external_torque
    found = Arm(URDF, effort='gravity_compensated').run(t, q, torque - gravity).external_torque
    np.testing.assert_allclose(found, expected, atol=1e-6)
    other = Arm(URDF, effort='current', torque_constants=constants)
    np.testing.assert_allclose(other.run(t, q, torque / constants).external_torque, expected)


@pytest.mark.parametrize('measurement', ['position', 'velocity'])
def test_positions_that_freeze_stop_the_estimates(free, measurement):
    arm, (t, q, torque, v) = Arm(URDF, measurement=measurement), (array.copy() for array in free)
    q[1500:2000], v[1500:2000] = q[1499], v[1499]
    found = arm.run(t, q, torque, v).external_torque
    assert (arm.counters['repeated'], arm.counters['standing still']) == (10, 490)
    assert np.isnan(found[1500:2000]).all()
    assert np.abs(found[2500:3000]).max() < 0.5


@pytest.mark.parametrize(('number', 'apart'), [(1, 1e-9), (100, 1e-6)])
def test_samples_that_nearly_coincide_are_no_jump_and_do_no_harm(free, number, apart):
    """Velocities of 10,000 rad/s: C^T qd, their square, would drive the next estimate."""
    arm, (t, q, torque, _) = Arm(URDF), (array[:1000].copy() for array in free)
    t[number], q[number] = t[number - 1] + apart, q[number - 1] + [NOISE, -NOISE, NOISE]
    assert np.nanmax(np.abs(arm.run(t, q, torque).external_torque)) < 100.0
    assert arm.counters['used'] > 990
    assert arm.counters['jumped'] == 0
    assert arm.take(round(t[999] * 1e9), q[999], torque[999]) is None
    assert arm.problem == 'not newer'
    assert arm.take(10**12, ['a', None, 0.0], torque[999]) is None
    assert arm.problem == 'wrong size'
    with pytest.raises(ConfigurationError, match='effort: expected shape'):
        arm.run([0.0], [[0.0] * 3], [[0.0] * 2])


@pytest.mark.parametrize(('wrong', 'options', 'text'), [
    (lambda tau, g, load: -tau, {}, 'the efforts of all joints have the wrong sign'),
    (lambda tau, g, load: tau * [1, -1, 1], {}, 'the effort of shoulder has the wrong sign'),
    (lambda tau, g, load: tau - g, {}, 'effort to gravity_compensated'),
    (lambda tau, g, load: 0 * g, {'effort': 'gravity_compensated'}, 'all efforts are zero'),
    (lambda tau, g, load: tau, {'effort': 'gravity_compensated'}, 'effort to torque'),
    (lambda tau, g, load: tau, {'gravity': [0.0, 0.0, -9.8]}, 'as if it were [4.0, 5.0, -7.4]'),
    (lambda tau, g, load: tau, {'gravity': [0.0] * 3}, 'as if it were [4.0, 5.0, -7.4]'),
    (lambda tau, g, load: 2.0 * tau, {}, 'effort is 2.1 times'),
    (lambda tau, g, load: tau + load, {'payload': [0.5, 0.0, 0.0, 0.4]}, 'payload to [1.'),
    (lambda tau, g, load: tau, {'payload': [1.5, 0.0, 0.0, 0.4]}, 'payload to [0, 0, 0, 0]'),
])  # fmt: skip
def test_a_setting_that_is_wrong_is_said(wrong, options, text):
    """On a base that is not level, so that a payload is seen whole."""
    gravity, payload = [4.0, 5.0, -7.4], [1.5, 0.0, 0.0, 0.4]
    model = ArmModel(URDF, gravity=gravity)
    t, q, _, torque = motion(model, np.arange(0.0, 9.0, 4e-3))
    g = np.array([model.terms(x, np.zeros(3)).gravity for x in q])
    model.set_payload(payload)
    load = np.array([model.terms(x, np.zeros(3)).gravity for x in q]) - g
    arm = Arm(URDF, {'gravity': gravity, **options})
    found = arm.run(t, q, wrong(torque, g, load))
    assert text in arm.doubts.text
    goes_on = any(word in text for word in ('payload', 'times'))  # which may be no mistake
    assert np.isfinite(found.external_torque[-1]).all() == goes_on
    arm.adopt(arm.parameters | {'payload': payload[::-1]})
    assert not arm.doubts.text


def test_an_arm_that_rests_has_effort_and_does_not_take_back_what_was_said():
    arm, (t, q, _, torque) = Arm(URDF), motion(MODEL, np.arange(0.0, 10.0, 4e-3))
    arm.run(t, q, -torque)
    rest = q[-1] + NOISE * np.random.default_rng(0).standard_normal((2000, 3))
    weight = -np.tile(MODEL.terms(q[-1], np.zeros(3)).gravity, (2000, 1))
    found = arm.run(10.0 + 0.05 * np.arange(2000), rest, weight)
    assert np.isnan(found.external_torque).all()
    arm = Arm(URDF)
    assert np.isnan(arm.run(0.05 * np.arange(2000), rest, 0.0 * rest).external_torque[-1]).all()


def test_a_wrench_is_found_at_a_frame_and_what_cannot_be_seen_is_said(free):
    arm, (t, q, torque, _) = Arm(URDF), free
    for k in range(1000):
        jacobian = arm.model.frame_jacobian(q[k], 'tool')
        estimate = arm.take(round(t[k] * 1e9), q[k], torque[k] - 8.0 * jacobian[0])
    wrench, near_singular = arm.wrench(estimate, 'tool')
    assert near_singular  # three joints do not see six numbers
    np.testing.assert_allclose(jacobian.T @ wrench, estimate.external_torque, atol=0.3)
    with pytest.raises(ConfigurationError, match='frame: expected one of'):
        arm.wrench(estimate, 'tol')


def test_noise_that_nobody_told_is_found_and_makes_no_contact(free):
    arm, random = Arm(URDF), np.random.default_rng(5)
    t, q, torque, _ = free
    noise = np.array([0.02, 0.2, 0.1])
    assert not arm.run(t, q, torque + noise * random.standard_normal(q.shape)).contact[500:].any()
    np.testing.assert_allclose(np.sqrt(arm._samples.variance[0]), noise, rtol=0.15)
    told = Arm(URDF, position_noise=[20.0 * NOISE])
    shaken = q + 20.0 * NOISE * random.standard_normal(q.shape)
    torque = torque + 0.5 * random.standard_normal(q.shape)
    found = Arm(URDF).run(t, shaken, torque)
    assert rms(found.external_torque) < 1.1 * rms(told.run(t, shaken, torque).external_torque)


def stamped(t, late):
    """Return stamps of a host that is late at each time, but never gives one stamp twice."""
    return np.maximum.accumulate(t + late) + 1e-9 * np.arange(len(t))


def hanging(t):
    """Return stamps of a host that hangs for 8 samples, and at times drops one of them."""
    stamps = t.copy()
    for k in range(500, len(t) - 8, 97):
        stamps[k : k + 8] = t[k + 8]
    return stamped(stamps, 0.0)


SHAKEN = PERIOD * np.random.default_rng(1).standard_normal(4000)
LOSSY = T[np.random.default_rng(2).random(4000) > 0.05]
FASTER, OTHER = (np.where(T < 2.0, T, 2.0 + share * (T - 2.0)) for share in (0.4, 0.8))
STAMPS = {
    # When samples were taken, their stamps, and what is counted.
    'jitter': (T, stamped(T, 0.1 * SHAKEN), {}),
    'samples jitter with them': (T + 0.1 * SHAKEN, T + 0.1 * SHAKEN, {}),
    'samples are missing': (LOSSY, stamped(LOSSY, 0.1 * SHAKEN[: len(LOSSY)]), {}),
    'another rate': (FASTER, stamped(FASTER, 0.02 * SHAKEN), {}),
    'another rate, and jitter': (OTHER, stamped(OTHER, 0.1 * SHAKEN), {}),
    'the driver publishes twice': (np.repeat(T[::2], 2), T, {}),
    'the host hangs, and samples are missing': (LOSSY, hanging(LOSSY), {}),
    'the clock is set forward a little': (T, stamped(T, 0.1 * SHAKEN + 0.02 * (T > 3.5)), {}),
    'the clock was 0 at first': (T, T + 1.7e9 * (T > 2.0), {'restarts': 1}),
    'the clock is set back': (T, T - 5.0 * (T > 2.0), {'clock set back': 1}),
}


@pytest.mark.parametrize('delay', [0.0, 0.005])
@pytest.mark.parametrize('case', STAMPS)
def test_an_arm_feels_as_well_with_bad_stamps_and_a_late_torque(case, delay):
    (sampled, stamps, counters), arm = STAMPS[case], Arm(URDF, torque_delay=delay)
    (_, q, _, _), (*_, torque) = (motion(MODEL, sampled - ago) for ago in (0.0, delay))
    found = arm.run(10.0 + stamps, q, torque)
    assert rms(found.external_torque[-1500:]) < 0.02
    assert not found.contact[-1000:].any()
    del arm.counters['used'], arm.counters['repeated']
    assert arm.counters == counters
