# SPDX-License-Identifier: Apache-2.0
"""Rigid-body terms, the filters over all joints, and what an arm makes of its samples."""

from dataclasses import replace
import re

import numpy as np
import pytest

pytest.importorskip('pinocchio')

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.arm.bank import Bank
from fhaosmo_ros.core.arm.calibration import Calibration
from fhaosmo_ros.core.arm.model import ArmModel, Payload
from fhaosmo_ros.core.arm.samples import Clock
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from robots import joint, JOINTS, link, motion, URDF

NOISE, PERIOD = 2e-5, 1e-3  # what an arm is told by default


@pytest.fixture(scope='module')
def model():
    return ArmModel(URDF)


@pytest.fixture(scope='module')
def free(model):
    t, q, v, torque = motion(model, 4.0)
    random = np.random.default_rng(0)
    return t, q + NOISE * random.standard_normal(q.shape), v, torque


@pytest.fixture
def arm():
    return Arm(URDF)


def run(arm, motion, begin=0, end=None, push=0.0):
    """Estimate from a part of a motion, with less torque by a push."""
    t, q, v, torque = (array[begin:end] for array in motion)
    return arm.run(t, q, torque - push, v)


def rms(torques):
    """Of what is estimated after half a second."""
    return np.sqrt(np.nanmean(torques[500:] ** 2))


def test_momentum_follows_from_the_terms(model):
    """p' = torque + C^T qd - g, by a difference of M(q) qd along a motion with torque."""
    q, v, a = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 3))
    torque = model.regressor(q, v, a) @ model.inertial.ravel()
    terms, h = model.terms(q, v), 1e-5
    p = [model.terms(q + s * v + 0.5 * s * s * a, v).mass @ (v + s * a) for s in (-h, h)]
    np.testing.assert_allclose(
        (p[1] - p[0]) / (2 * h), torque + terms.coriolis - terms.gravity, atol=1e-6
    )


def test_a_payload_is_weight_at_its_place():
    model, q, rest = ArmModel(URDF), np.array([0.0, np.pi / 2, 0.0]), np.zeros(3)
    bare = model.terms(q, rest).gravity  # stretched out along x
    model.set_payload(Payload(1.5, (0.0, 0.0, 0.4)))
    more = model.terms(q, rest).gravity - bare
    np.testing.assert_allclose(more, [0.0, -1.5 * 9.81 * 0.8, -1.5 * 9.81 * 0.4], atol=1e-9)
    weight = np.array([1.5 * 9.81, 0.0, 0.0, 0.0, 0.0, 0.0])  # the tool's own x points downwards
    np.testing.assert_allclose(model.frame_jacobian(q, 'tool').T @ weight, -more, atol=1e-9)


@pytest.mark.parametrize(('urdf', 'options', 'text'), [
    ('<sdf/>', {}, 'expected a URDF'),
    ('<robot name="r"><link name="a"/></robot>', {}, 'expected a joint that moves'),
    (URDF.replace('type="revolute"', 'type="floating"', 1), {}, 'got a floating one'),
    (URDF, {'joints': ['elbo']}, 'joints: expected some of turn, shoulder, elbow, got elbo'),
    (re.sub(r'(mass value|\bi..)="[^"]*"', r'\1="0"', URDF), {}, 'mass'),
])  # fmt: skip
def test_robots_that_cannot_be_used_are_refused_in_one_line(urdf, options, text):
    with pytest.raises(ConfigurationError, match=text) as error:
        ArmModel(urdf, **options)
    assert '\n' not in str(error.value)


def test_mimic_joints_and_grippers_are_left_out_and_joints_may_be_chosen():
    more = URDF.replace('</robot>', ''.join([
        link('jaw', 0.1, 0.1), link('other', 0.1, 0.1),
        joint('left_finger', 'tool', 'jaw', '1 0 0', 0.0, 'prismatic'),
        joint('second', 'tool', 'other', '1 0 0', 0.0).replace(
            '</joint>', '<mimic joint="left_finger"/></joint>'),
        '</robot>',
    ]))  # fmt: skip
    assert ArmModel(more).joints == JOINTS
    assert ArmModel(more, joints=['shoulder', 'elbow']).joints == ('shoulder', 'elbow')


@pytest.mark.parametrize('kind', ['continuous', 'prismatic'])
def test_other_joints_than_revolute_ones(kind):
    urdf = URDF.replace('name="turn" type="revolute"', f'name="turn" type="{kind}"')
    arm = Arm(urdf)
    t, q, _, torque = motion(arm.model, 1.0)
    if kind == 'continuous':
        q[:, 0] = np.remainder(q[:, 0] - q[300, 0], 2 * np.pi)  # it passes the seam
    found = arm.run(t, q, torque)
    assert np.abs(found.external_torque[500:]).max() < 2.0
    assert arm.counters['used'] == len(t) - 1


def test_without_noise_one_filter_is_the_kalman_filter():
    """One joint, weights fixed by rates of zero: compare with the textbook recursion."""
    h, w, r, e = 1e-3, 4.0, 1e-8, 0.01
    bank = Bank([w], 1e-9, [1.0], (0.0, 0.0, 0.0))
    bank.start(1.0, 0.0, [0.0], [[1.0]], [1.0])
    x, p = np.zeros(3), np.diag([0.0, 1.0, 1.0])
    f = np.array([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]])
    g = np.array([h * h / 2, h, 0.0])
    q = w * np.array([
        [h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h * h / 2], [h**3 / 6, h * h / 2, h]
    ]) + np.outer(g, g) * e  # fmt: skip
    random, y, one, before = np.random.default_rng(1), 0.0, np.eye(1), 0.0
    for _ in range(50):
        moved, u = 1e-4 * random.standard_normal(), random.standard_normal()
        y += moved
        bank.step(h, one, np.array([moved]), np.array([r]), 0.0, np.array([u]), np.array([e]), one)
        x, p, before = f @ x + g * 0.5 * (before + u), f @ p @ f.T + q, u
        k = p[:, 0] / (p[0, 0] + r)
        x, p = x + k * (y - x[0]), p - np.outer(k, p[0])
    np.testing.assert_allclose(bank.mean[1:, 0], x[1:], rtol=1e-6)
    np.testing.assert_allclose(bank.mean[0, 0], x[0] - y, atol=1e-12)
    np.testing.assert_allclose(bank.covariance, [[p[2, 2]]], rtol=1e-6)
    with pytest.raises(ValueError, match='arrays of 1 joints'):
        bank.step(h, one, np.zeros(2), np.array([r]), 0.0, np.array([u]), np.array([e]), one)


def test_a_force_that_is_there_at_once_is_not_taken_for_one_that_grows():
    """The first sample of a step of d = 1: its mean over the sample, not half as much again."""
    h, seen = 1e-3, {}
    for onset in (0.0, 0.1):
        bank = Bank([1e-9], 3.0, [1.0], (1.0, 1.0, 0.0), onset, of_position=False)
        tiny, one = np.array([1e-16]), np.eye(1)
        for change in [0.0] * 20 + [h]:
            bank.step(h, one, np.array([change]), tiny, 0.0, np.zeros(1), tiny, one)
        seen[onset] = float(bank.mean[2, 0])
    assert 1.3 < seen[0.0] < 1.6
    assert abs(seen[0.1] - 1.0) < 0.05


@pytest.mark.parametrize('measurement', ['position', 'velocity'])
def test_two_thirds_of_the_errors_in_contact_are_within_a_standard_deviation(free, measurement):
    t, q, v, torque = free
    random = np.random.default_rng(10)
    noise = 1e-4 * random.standard_normal(v.shape), 0.3 * random.standard_normal(v.shape)
    push = np.sin(np.pi * np.clip((t - 1.0) / 2.0, 0.0, 1.0))[:, np.newaxis] ** 2 * [3.0, -4.0, 0]
    arm = Arm(URDF, measurement=measurement, velocity_noise=[1e-4])
    found = arm.run(t, q, torque - push + noise[1], v + noise[0])
    away = (np.abs(found.external_torque - push) / found.standard_deviation)[1100:2900]
    assert 0.6 < np.mean(away < 1.0) < 0.76
    assert 0.9 < np.mean(away < 1.96) < 0.98


@pytest.mark.parametrize('measurement', ['position', 'velocity'])
def test_a_push_is_found_told_and_located(free, measurement):
    arm = Arm(URDF, measurement=measurement, velocity_noise=[1e-4])
    pushed = np.zeros((4000, 3))
    pushed[2000:] = 3.0, -4.0, 0.0
    # The motion is the same because the drives hold against the push.
    found = run(arm, free, push=pushed)
    np.testing.assert_allclose(found.external_torque[2200:].mean(axis=0), pushed[-1], atol=0.15)
    assert not found.contact[200:2000].any()
    assert found.contact[2200:].mean() > 0.95
    assert found.link[2200:].count('upper') > 0.9 * 1800
    assert rms((found.velocity - free[2])[1700:]) < 0.03


def test_tare_takes_the_present_torque_for_zero(free, arm):
    before = run(arm, free, 0, 2100, push=2.0)
    arm.tare()
    after = run(arm, free, 2100, 3000, push=2.0)
    assert np.abs(before.external_torque[-1] - 2.0).max() < 0.3
    assert np.abs(after.external_torque[[0, -1]]).max() < 0.3  # at once, and later


def test_currents_gravity_compensated_effort_and_a_late_torque(free, model, arm):
    t, q, v, torque = free
    gravity = np.array([model.terms(*row).gravity for row in zip(q, v, strict=True)])
    expected = run(arm, free).external_torque
    other = Arm(URDF, effort='gravity_compensated')
    np.testing.assert_allclose(run(other, free, push=gravity).external_torque, expected, atol=1e-6)
    constants = [8.0, 4.0, 0.5]
    other = Arm(URDF, effort='current', torque_constants=constants)
    np.testing.assert_allclose(other.run(t, q, torque / constants).external_torque, expected)
    late = np.vstack([np.repeat(torque[:1], 5, axis=0), torque[:-5]])
    told, ignored = (Arm(URDF, torque_delay=s).run(t, q, late) for s in (0.005, 0.0))
    assert rms(told.external_torque) < 0.5 * rms(ignored.external_torque)


@pytest.mark.parametrize(('change', 'counter'), [
    (lambda q, e: (q * np.nan, e), 'not finite'),
    (lambda q, e: (np.degrees(q) + 90.0, e), 'beyond limits'),
    (lambda q, e: (q[:2], e), 'wrong size'),
    (lambda q, e: (['a', None, 0.0], e), 'wrong size'),
    (lambda q, e: (q, e * 1e300), 'too strong'),
    (lambda q, e: (q + 0.5, e), 'jumped'),
])  # fmt: skip
def test_bad_samples_are_counted_and_survived(free, arm, change, counter):
    t, q, _, torque = free
    run(arm, free, end=500)
    stamp = round(t[499] * 1e9)
    assert arm.take(stamp + 1_000_000, *change(q[500], torque[500])) is None
    assert arm.problem == counter
    assert arm.counters[counter] == 1
    found = run(arm, free, 501, 1500)
    assert np.abs(found.external_torque[-1]).max() < 0.5
    assert arm.take(round(t[1490] * 1e9), q[1490], torque[1490]) is None
    assert arm.problem == 'not newer'
    arm.run(t[1500:1502] + 10.0, q[1500:1502], torque[1500:1502])
    assert arm.counters['restarts'] == 1
    found = run(arm, free, 1502, 1600)
    assert arm.counters['clock set back'] == 1
    assert np.isfinite(found.external_torque[5:]).all()


@pytest.mark.parametrize('measurement', ['position', 'velocity'])
def test_positions_that_freeze_stop_the_estimates(free, measurement):
    arm = Arm(URDF, measurement=measurement)
    run(arm, free, end=1500)
    t, q, v, torque = free
    stuck = (t, np.broadcast_to(q[1499], q.shape), np.broadcast_to(v[1499], q.shape), torque)
    found = run(arm, stuck, 1500, 2000)
    assert arm.counters['standing still'] == 500
    assert np.isnan(found.external_torque).all()
    assert np.abs(run(arm, free, 2000, 3000).external_torque[-500:]).max() < 0.5


def test_a_driver_that_repeats_each_position_is_one_of_half_the_rate(free, arm):
    t, *arrays = free
    found = run(arm, (t, *(np.repeat(array[::2], 2, axis=0) for array in arrays)))
    assert arm.counters['standing still'] > 0.4 * len(t)
    once = run(Arm(URDF), [array[::2] for array in free])
    assert rms(found.external_torque[500:]) < 1.5 * rms(once.external_torque)


def test_samples_a_nanosecond_apart_do_not_make_estimates_grow_without_end(free, arm):
    """Their velocity is 10,000 rad/s, and C^T qd, its square, would drive the next one."""
    t, q, v, torque = (array.copy() for array in free)
    t[1], q[1] = t[0] + 1e-9, q[0] + [1e-5, -1e-5, 1e-5]
    found = run(arm, (t, q, v, torque), end=1000)
    assert np.nanmax(np.abs(found.external_torque)) < 100.0
    assert arm.counters['used'] > 990


def test_limits_that_the_urdf_does_not_say_are_none(free):
    arm = Arm(re.sub('<limit .*?/>', '<limit velocity="0" effort="0"/>', URDF))
    run(arm, free, end=100)
    assert arm.counters == {'used': 99}


@pytest.mark.parametrize(('wrong', 'options', 'text'), [
    (lambda tau, g, load: -tau, {}, 'the efforts of all joints have the wrong sign'),
    (lambda tau, g, load: tau * [1, -1, 1], {}, 'the effort of shoulder has the wrong sign'),
    (lambda tau, g, load: tau - g, {}, 'effort to gravity_compensated'),
    (lambda tau, g, load: tau, {'effort': 'gravity_compensated'}, 'effort to torque'),
    (lambda tau, g, load: tau, {'gravity': [0.0, 0.0, -9.8]}, 'as if it were [3.97, 5.0'),
    (lambda tau, g, load: tau + load, {}, 'parameter payload to [1.'),
])  # fmt: skip
def test_a_setting_that_is_wrong_is_said(wrong, options, text):
    """On a base that is not level, so that a payload is seen whole."""
    gravity, payload = [4.0, 5.0, -7.4], Payload(1.5, (0.0, 0.0, 0.4))
    model = ArmModel(URDF, gravity=gravity)
    t, q, _, torque = motion(model, 9.0, period=4e-3)
    g = np.array([model.terms(x, np.zeros(3)).gravity for x in q])
    model.set_payload(payload)
    load = np.array([model.terms(x, np.zeros(3)).gravity for x in q]) - g
    arm = Arm(URDF, {'gravity': gravity, **options})
    found = arm.run(t, q, wrong(torque, g, load))
    assert text in arm.doubts.text
    assert np.isfinite(found.external_torque[-1]).all() == ('payload' in text)  # no mistake


def test_samples_that_nearly_coincide_are_no_jump(free, arm):
    t, q, _, torque = free
    run(arm, free, end=100)
    assert arm.take(round(t[99] * 1e9) + 1000, q[99] + 3 * NOISE, torque[99]) is not None


def test_a_wrench_is_found_at_a_frame_and_what_cannot_be_seen_is_said(free, arm):
    t, q, _, torque = free
    for k in range(1000):
        jacobian = arm.model.frame_jacobian(q[k], 'tool')
        estimate = arm.take(round(t[k] * 1e9), q[k], torque[k] - 8.0 * jacobian[0])
    wrench = arm.wrench(estimate, 'tool')
    assert wrench.near_singular  # three joints do not see six numbers
    explained = jacobian.T @ np.concatenate([wrench.force, wrench.torque])
    np.testing.assert_allclose(explained, estimate.external_torque, atol=0.3)


@pytest.mark.parametrize(('named', 'text'), [
    ({'position_noise': [1e-5, 1e-5]}, '1 or 3 numbers'),
    ({'payload': [-1.0, 0.0, 0.0, 0.0]}, 'mass >= 0'),
    ({'gravity': [9.81]}, 'three numbers'),
    ({'calibration_file': '/none.yaml'}, 'calibration_file'),
    ({'calibration': replace(Calibration.of_urdf(ArmModel(URDF)), joints=('a', 'b', 'c'))},
     'expected the joints turn, shoulder, elbow'),
])  # fmt: skip
def test_what_does_not_fit_is_refused(arm, named, text):
    with pytest.raises(ConfigurationError, match=text):
        Arm(URDF, **named)
    with pytest.raises(ConfigurationError, match='effort: expected shape'):
        arm.run([0.0], [[0.0] * 3], [[0.0] * 2])
    with pytest.raises(ConfigurationError, match='frame: expected one of'):
        arm.model.frame_jacobian([0.0] * 3, 'tol')


def test_noise_that_nobody_told_is_found_and_makes_no_contact(free, arm):
    random = np.random.default_rng(5)
    t, q, _, torque = free
    noise = np.array([0.02, 0.2, 0.1])
    noisy = torque + noise * random.standard_normal(q.shape)
    assert not arm.run(t, q, noisy).contact[500:].any()
    np.testing.assert_allclose(np.sqrt(arm._samples.noise.variance[0]), noise, rtol=0.15)
    told = Arm(URDF, position_noise=[20.0 * NOISE], torque_noise=[0.5])
    shaken = q + 20.0 * NOISE * random.standard_normal(q.shape)
    found = Arm(URDF, torque_noise=[0.5]).run(t, shaken, torque)
    assert rms(found.external_torque) < 1.1 * rms(told.run(t, shaken, torque).external_torque)
    np.testing.assert_array_equal(told._samples.noise.variance[0], 0.25)


def intervals(sampled, stamps):
    """Return the clock, and the intervals that it gives to sines sampled at these times."""
    clock, speed, variance = Clock(), np.array([1.0, 2.3]), np.full(2, NOISE**2)
    angle = np.outer(sampled, speed)
    steps = zip(np.diff(stamps), np.diff(np.sin(angle), axis=0), np.cos(angle[:-1]), strict=True)
    return clock, np.array([clock.interval(h, m, speed * v, variance) for h, m, v in steps])


def hanging(t):
    """Return stamps of a host that hangs for 8 samples, and at times drops one of them."""
    stamps = t.copy()
    for k in range(500, len(t) - 8, 97):
        stamps[k : k + 8] = t[k + 8]
    return np.maximum.accumulate(stamps) + 1e-9 * np.arange(len(t))


def test_stamps_that_jitter_around_even_samples_are_evened_out():
    late, t = 0.2, 2.0 + PERIOD * np.arange(4000.0)
    stamps = t + late * PERIOD * np.random.default_rng(1).standard_normal(4000)
    clock, found = intervals(t, np.maximum.accumulate(stamps) + 1e-9 * np.arange(4000))
    assert clock.even
    assert np.quantile(np.abs(found[500:] - PERIOD), 0.99) < 0.08 * late * PERIOD


def test_samples_that_jitter_with_their_stamps_are_left_as_they_are():
    t = PERIOD * (np.arange(4000.0) + 0.1 * np.random.default_rng(1).standard_normal(4000))
    clock, found = intervals(t, t)
    assert not clock.even
    np.testing.assert_array_equal(found[100:], np.diff(t)[100:])


def test_missing_samples_and_another_rate_are_followed():
    random = np.random.default_rng(2)
    t = PERIOD * np.flatnonzero(random.random(4000) > 0.05)
    t = np.concatenate([t, t[-1] + 0.4 * PERIOD * np.arange(1, 4000)])
    stamps = t + 2e-5 * random.standard_normal(len(t))
    clock, found = intervals(t, stamps)
    assert clock.even
    late = np.r_[500:3000, len(t) - 2000 : len(t) - 1]
    np.testing.assert_allclose(found[late], np.diff(t)[late], atol=5e-6)


@pytest.mark.parametrize('lost', [0.0, 0.05])
def test_stamps_of_a_host_that_hangs_are_known_by_the_motion(lost):
    t = PERIOD * np.flatnonzero(np.random.default_rng(2).random(4000) >= lost)
    stamps = hanging(t)
    _, found = intervals(t, stamps)
    assert np.diff(stamps).max() > 7.0 * PERIOD
    np.testing.assert_allclose(found[100:], np.diff(t)[100:], rtol=0.02)


def test_a_clock_that_is_set_forward_does_not_begin_the_evening_anew():
    t = PERIOD * np.arange(4000.0)
    stamps = t + 0.1 * PERIOD * np.random.default_rng(1).standard_normal(4000)
    stamps[2000:] += 0.02
    np.testing.assert_allclose(intervals(t, stamps)[1][500:], PERIOD, rtol=0.03)


@pytest.mark.parametrize('delay', [0, 5])
@pytest.mark.parametrize('silence', [0.4, 1.7e9])
def test_silence_begins_the_estimates_anew(model, silence, delay):
    """With 1.7e9 s the clock went from 0 to that of today."""
    t, q, _, torque = motion(model, 1.0)
    arm = Arm(URDF, torque_delay=delay * PERIOD)
    estimates = arm.run(t + np.where(t < 0.5, 1.0, 1.0 + silence), q, torque)
    assert arm.counters['restarts'] == 1
    assert np.isfinite(estimates.external_torque[-1]).all()


@pytest.mark.parametrize('jitter', [0.0, 1e-4])
@pytest.mark.parametrize('hangs', [False, True])
@pytest.mark.parametrize('delay', [0, 5])
def test_an_arm_feels_as_well_with_bad_stamps(model, jitter, hangs, delay):
    t, q, _, torque = motion(model, 4.0)
    torque = torque[np.maximum(np.arange(len(t)) - delay, 0)]
    stamps = 10.0 + t + jitter * np.random.default_rng(3).standard_normal(len(t))
    error = []
    for given in (t, hanging(stamps) if hangs else stamps):
        estimates = Arm(URDF, torque_delay=delay * PERIOD).run(given, q, torque)
        error.append(rms(estimates.external_torque[500:]))
        assert not estimates.contact[1000:].any()
    assert error[1] < error[0] + 0.02
