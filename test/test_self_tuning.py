# SPDX-License-Identifier: Apache-2.0
"""The self-tuning observer: its members are Kalman filters; together they fit y by themselves."""

import math

from fhaosmo_ros.core import Observer, OnlineEstimator, Plant, Status
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.self_tuning.intervals import within
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.tuning.tuner import stamps_of
import numpy as np
from observer_cases import discrete, matern, states_of
import pytest
from scipy.signal import lfilter
from scipy.stats import norm, truncnorm
from studies.everywhere import Condition, CONDITIONS, PLANTS, recording, setting_of
from studies.harness import observed
from studies.self_tuning import estimate as plain_estimate

PERIOD = 1e-3
SELF_TUNING = {'gains': 'self_tuning'}
AS_TUNED = CONDITIONS['as tuned']
plants = pytest.mark.parametrize('plant', PLANTS)


def study(plant, condition=AS_TUNED, kind='sine', seconds=20.0, seed=31):
    """Return a recording of one of the study's plants, and the parameters of its model."""
    plant = PLANTS[plant]
    values = setting_of(plant, condition).told | SELF_TUNING
    return recording(plant, condition, kind, seconds, seed), values


def chain(order, rng):
    """Return 8 s of y and d of integrators with a loss at the last one, and parameters for it."""
    model = np.diag(np.ones(order - 1), 1)
    model[-1, -1] = -3.0
    d = matern(8_000, 1.0, 1, rng)
    phi = ['0'] * (order - 1) + [f'-3*z{order}']
    return states_of(model, d, [0.1] * order)[:, 0], d, {'order': order, 'phi': phi}


def estimated(values, t, y):
    return OnlineEstimator(values).run(stamps_of(t), y)


@pytest.fixture(scope='module')
def case():
    """Return times, z, d of the paper's plant for 20 s, and unit noise."""
    rng = np.random.default_rng(4)
    count = 30_000
    d = 0.07 * matern(count, 1.5, 2, rng)
    z = states_of(np.diag([1.0, 1.0], 1) - np.diag([0.0, 0.0, 1.0]), d, [0.2, 0.2, 0.2])
    noise = rng.standard_normal(count)
    return tuple(values[:20_000] for values in (np.arange(count) * PERIOD, z, d, noise))


def test_linear_models_are_known():
    """Only those may keep their covariances once they are steady."""
    for last in ('-z2', 'u/2 - 3*z2 + sin(u)', 'z1*2 - z1'):
        assert TriangularModel(['0', last]).is_linear
    for last in ('u*z2', 'sin(z1)', 'z1*z2', '1/(1 + z2)', 'min(z1, 1)', 'z2**2'):
        assert not TriangularModel(['0', last]).is_linear


LATER = np.arange(20_000) >= 15_000
OUTLIERS = 50.0 * (np.random.default_rng(2).uniform(size=20_000) < 0.01)
HEAVY = np.random.default_rng(3).standard_t(3.0, 20_000)
NOISES = {
    # noise on y by unit noise; bound of the error over d; size and correlation at the end
    'little': (lambda n: 1e-4 * n, 0.2, 1e-4, 0.0),
    'usual': (lambda n: 1e-3 * n, 0.35, 1e-3, 0.0),
    '100 times as much later': (lambda n: 1e-4 * np.where(LATER, 100, 1) * n, 0.35, 1e-2, 0.0),
    'coloured': (lambda n: 1e-3 * lfilter([math.sqrt(0.19)], [1.0, -0.9], n), 0.6, 1e-3, 0.9),
    'outliers': (lambda n: 1e-3 * (1.0 + OUTLIERS) * n, 0.4, 1e-3, 0.0),
    'heavy tails': (lambda _: 1e-3 * HEAVY, 0.4, 1.6e-3, 0.0),
}  # fmt: skip


@pytest.mark.parametrize('name', NOISES)
def test_it_finds_noise_and_d(case, name):
    """Error, error bars and noise without any parameter but the model, from the start on."""
    (t, z, d, unit), (noise_of, bar, size, correlation) = case, NOISES[name]
    observer = Observer(SELF_TUNING)
    run = observer.run(t, z[:, 0] + noise_of(unit))
    error = np.abs(run.unknown_input - d)
    assert rms(error[5000:]) < bar * rms(d)
    assert error.max() < 1.5 * np.abs(d).max()
    assert not (run.status & Status.JUMPED).any()
    assert observer.tuning.noise == pytest.approx(size, rel=0.3 if name == 'heavy tails' else 0.2)
    assert observer.tuning.correlation == pytest.approx(correlation, abs=0.05)
    if name in ('little', 'usual'):
        expected = run.standard_deviation[5000:, 3]
        assert 0.5 < np.mean(error[5000:] < expected) < 0.86
        assert np.mean(error[5000:] < 1.96 * expected) > 0.8


@pytest.mark.parametrize(('size', 'seconds'), [(0.05, 0.5), (1.0, 0.05), (-2.0, 5.0)])
def test_a_wrong_angle_is_no_wrong_gravity(size, seconds):
    """Believed, it would be a d of up to 19.6: y less its offset is used instead (D 23)."""
    r, values = study('pendulum', seed=5)
    off = (r.t > 9.0) & (r.t < 9.0 + seconds)
    run = estimated(values, r.t, r.y + size * off)
    jumps = r.t[(run.status & Status.JUMPED) > 0]
    np.testing.assert_allclose(jumps, [9.0, 9.0 + seconds], atol=0.03)
    wrong = np.abs(run.unknown_input - r.d)[r.t > 5.0]
    assert wrong.max() < 0.1 * np.abs(r.d).max()
    assert np.abs(run.z[:, 0] - r.y)[r.t > 5.0].max() < 0.01


def test_a_plant_that_is_elsewhere_is_no_jump_of_y():
    """z_2 differs from then on, so that y leaves its prediction after a jump that was believed."""
    t, y, d = swept()
    order = np.concatenate([np.arange(12_000), np.arange(11_000, 19_000)])
    y = y[order] + 4.4e-4 * np.random.default_rng(3).standard_normal(len(t))
    run = Observer(MOTOR).run(t, y)
    wrong = np.abs(run.unknown_input - d[order])
    assert wrong.max() < 2.0 * np.abs(d).max()
    assert rms(wrong[13_000:]) < 0.05 * rms(d)


@pytest.mark.parametrize(('sigmas', 'seconds'), [
    (3.5, 0.02), (3.5, 0.5), (5.0, 0.02), (-5.0, 0.5), (6.5, 0.5), (8.0, 0.02), (1000.0, 0.5),
])  # fmt: skip
def test_an_offset_of_y_is_not_taken_for_d(case, sigmas, seconds):
    """Within, and just beyond what counts as lost; before D 35 d was off by 100s of times."""
    t, z, d, noise = case
    y = z[:, 0] + 1e-3 * noise + 1e-3 * sigmas * ((t > 15.0) & (t < 15.0 + seconds))
    run = Observer(SELF_TUNING).run(t, y)
    assert np.abs(run.unknown_input - d).max() < 1.5 * np.abs(d).max()
    if not 4.0 < abs(sigmas) < 10.0:  # those are sometimes lost samples, and y begins afresh
        jumps = t[(run.status & Status.JUMPED) > 0]
        atol = 0.016 if abs(sigmas) < 4.0 else 0.022
        np.testing.assert_allclose(jumps, [15.0, 15.0 + seconds], atol=atol)


def test_another_rate_and_lost_samples(case):
    """Every tenth sample; half of them from the middle on; few, but 180 soon after the start."""
    t, z, d, noise = case
    random, count = np.random.default_rng(3), len(t)
    half = (random.uniform(size=count) < 0.5) | (t < 10.0)
    few = np.convolve(random.uniform(size=count) < 0.003, np.ones(7), 'same') < 0.5
    few &= (t < 0.03) | (t > 0.21)
    for size, kept in (1e-4, np.arange(count) % 10 == 0), (1e-4, half), (1e-3, few):
        error = Observer(SELF_TUNING).run(t[kept], (z[:, 0] + size * noise)[kept]).unknown_input
        error -= d[kept]
        assert np.abs(error).max() < 1.5 * np.abs(d).max()
        assert rms(error[t[kept] > 5.0]) < 0.6 * rms(d)


MOTOR = {**SELF_TUNING, 'order': 2, 'phi': ['0', '-25*z2']}


def swept(period=PERIOD, shape=np.sin):
    """Return times, z_1 and d of the motor from rest, d a function of its phase at 3 rad/s."""
    t = np.arange(0.0, 20.0, period)
    d = 70.0 * shape(3.0 * t)
    return t, states_of(np.array([[0.0, 1.0], [0.0, -25.0]]), d, period=period)[:, 0], d


@pytest.mark.parametrize('period', [1e-3, 1e-2])
@pytest.mark.parametrize('noise', [0.0, 4.4e-7, 4.4e-5, 4.4e-4])
def test_little_noise_or_none(noise, period):
    """A smooth d moves y by up to 1e5 times the noise in a sample; d is found, with its jumps."""
    for shape, limit in ((np.sin, 0.03), (lambda phase: np.sign(np.sin(phase)), 0.6)):
        t, y, d = (values[: -round(0.5 / period)] for values in swept(period, shape))  # to no jump
        y = y + noise * np.random.default_rng(7).standard_normal(len(t))
        observer = Observer(MOTOR)
        run = observer.run(t, y)
        assert rms((run.unknown_input - d)[t > 3.0]) < limit * rms(d)
        assert abs(run.unknown_input).max() < 5.0 * 70.0  # a limit cycle has 8
        if noise and period == PERIOD:  # a large d is not taken for noise
            assert observer.tuning.noise == pytest.approx(noise, rel=0.3)


@pytest.mark.parametrize('noise', [4.4e-5, 4.4e-4])
def test_noise_that_begins_where_there_was_none_is_seldom_taken_for_d(noise):
    """Its first samples may look like a jump of d, in few runs."""
    t, y, d = (values[:12_000] for values in swept())
    peaks, errors = [], []
    for seed in range(12):
        noisy = noise * np.random.default_rng(seed).standard_normal(2_200)
        found = Observer(MOTOR).run(t, np.append(y[:9_800], y[9_800:] + noisy)).unknown_input
        peaks.append(np.abs(found).max() / np.abs(d).max())
        errors.append(rms((found - d)[9_800:]) / rms(d))
    assert np.median(peaks) < 1.5
    assert max(errors) < 1.5


@pytest.mark.parametrize('seed', [0, 2, 4])
def test_a_host_that_stamps_later_for_dozens_of_samples(seed):
    """By 10 us, and it wakes unevenly by 25: that is y without noise, and no d."""
    random, count = np.random.default_rng(seed), 20_000
    t = PERIOD * np.arange(1, count) + 25e-6 * random.standard_normal(count - 1)
    truth = Plant().simulate(np.concatenate([[0.0], t]))
    y, d = truth.y[1:], truth.unknown_input[1:]
    late = 1e-5 * (np.cumsum(random.random(count - 1) < 0.02) % 2)
    late += t + 2e-6 * random.standard_normal(count - 1)
    found = estimated(SELF_TUNING, late, y).unknown_input
    assert rms((found - d)[t > 5.0]) < 0.1 * rms(d)
    assert np.abs(found).max() < 1.5 * np.abs(d).max()
    noisy = y + 1e-4 * random.standard_normal(count - 1) * (t > 13.0)
    assert np.abs(estimated(SELF_TUNING, late, noisy).unknown_input).max() < 2.0 * np.abs(d).max()


@pytest.mark.parametrize(('seed', 'first'), [(0, 0), (1, 0), (2, 0), (1, 0.4), (2, 2.5)])
def test_a_y_that_is_sampled_at_uneven_times_is_not_noisy(seed, first):
    """A host that is busy samples late, and stamps rightly, or the rate changes for good."""
    random = np.random.default_rng(seed)
    intervals = PERIOD * random.uniform(0.3, np.where(random.random(8000) < 0.15, 9.0, 1.2))
    if first:
        intervals = PERIOD * np.where(np.arange(8000) < 400, first, 1.0)
    t = np.cumsum(intervals)
    model = {'order': 2, 'phi': ['0', '-0.8*z2']}
    plant = Plant(**model, disturbance_omega=3.0, noise_std=1e-5 if first else 0.0)
    truth = plant.simulate(np.concatenate([[0.0], t]))
    d, found = truth.unknown_input[1:], estimated(model | SELF_TUNING, t, truth.y[1:])
    assert rms((found.unknown_input - d)[t > 0.5 * t[-1]]) < 0.05 * rms(d)


@pytest.mark.parametrize(('seed', 'period', 'shape', 'most'), [
    (0, PERIOD, 'sine', 0.1), (1, PERIOD, 'sine', 0.1), (2, PERIOD, 'sine', 0.1),
    (8, 10 * PERIOD, 'square', 0.6), (22, 20 * PERIOD, 'sine', 0.3),
])  # fmt: skip
def test_samples_that_wait_for_a_host_that_hangs_are_evenly_spaced(seed, period, shape, most):
    """It hangs for up to 10 or 20 periods at one of 50 samples, and stamps at once what waits."""
    random, t = np.random.default_rng(seed), period * np.arange(8001)
    longest = 10.0 if period == PERIOD else 20.0
    hangs = np.where(random.random(8001) < 0.02, random.uniform(0.5, longest, 8001), 0.0)
    late = hangs + 0.02 * random.standard_exponential(8001)
    stamps = np.maximum.accumulate(t + period * late) + 1e-3 * period * np.arange(8001)
    model = {'order': 2, 'phi': ['0', '-0.8*z2']}
    truth = Plant(**model, disturbance_omega=3.0, disturbance=shape).simulate(t)
    found = estimated(model | SELF_TUNING, stamps, truth.y)
    error = (found.unknown_input - truth.unknown_input)[1000:]
    assert rms(error) < most * rms(truth.unknown_input)


@pytest.mark.parametrize('changes', [{}, SELF_TUNING])
def test_a_driver_that_empties_a_buffer_does_no_harm(case, changes):
    t, z, d, noise = case
    burst = np.floor(t / (16.3 * PERIOD))
    read = 16.3 * PERIOD * (burst + 1) + 5e-6 * (np.arange(len(t)) - np.searchsorted(burst, burst))
    exact, found = (
        rms((estimated(changes, times, z[:, 0] + 1e-6 * noise).unknown_input - d)[10_000:])
        for times in (t, read)
    )
    assert found < 1.1 * exact


@pytest.mark.parametrize('first', [0.0, 1.0, -100.0])
def test_it_begins_wherever_the_plant_is(first):
    """Where Phi_1 is not 0, z_2 of a plant that stands still is far off what y's speed tells."""
    model = np.array([[-20.0, 1.0], [0.0, -1.0]])
    d = 20.0 * first + matern(8000, 2.0, 2, np.random.default_rng(6))
    y = states_of(model, d, [first, 20.0 * first])[:, 0]
    y += 1e-5 * np.random.default_rng(7).standard_normal(len(y))
    values = SELF_TUNING | {'order': 2, 'phi': ['-20*z1', '-z2']}
    estimator = OnlineEstimator(values)
    error = estimator.run(stamps_of(np.arange(len(y)) * PERIOD), y).unknown_input - d
    assert estimator.counters.rejected < 20
    assert rms(error[2000:]) < 0.2 + 0.02 * abs(first)
    assert np.abs(error).max() < 2.0 * np.abs(d).max()


@pytest.mark.parametrize('noise', [0.0, 1e-5])
@pytest.mark.parametrize('file', ['self_tuning', 'models/paper_plant'])
def test_a_sample_that_its_host_stamps_late_is_not_rejected(case, file, noise):
    """A host that is busy between measuring and stamping makes the interval longer by as much."""
    t, z, d, unit = case
    rng = np.random.default_rng(5)
    usual = 0.003 * PERIOD * rng.standard_exponential(len(t))
    late = usual.copy()
    late[1000::97] += PERIOD * rng.uniform(0.1, 0.9, len(late[1000::97]))
    errors = []
    for off in usual, late:
        estimator = OnlineEstimator.from_yaml(f'config/{file}.yaml')
        run = estimator.run(stamps_of(t + off), z[:, 0] + noise * unit)
        errors.append(rms((run.unknown_input - d)[5000:]))
    assert errors[1] < 1.2 * errors[0]
    assert estimator.counters.rejected < 0.03 * np.count_nonzero(late > 0.1 * PERIOD)


@pytest.mark.parametrize('seed', [0, 10, 16])
def test_a_usual_jump_of_d_is_believed_at_the_second_sample_and_two_outliers_are_none(seed):
    """With d = 0.2 at the start, too: what is usual is not known yet."""
    t = np.arange(4000) / 10.0
    d = 0.2 * np.sign(np.sin(0.1 * t + 0.01))
    y = 0.1 * np.concatenate([[0.0], np.cumsum(d[:-1])])
    y += 2e-3 * np.random.default_rng(seed).standard_normal(len(t))
    y[3500:3502] += [3.0, 6.0]  # as a d of 30 would do it
    wrong = np.abs(Observer(SELF_TUNING, order=1, phi=['0']).run(t, y).unknown_input - d)
    for jump in np.flatnonzero(np.diff(d))[3:] + 1:  # 13 noises a sample
        assert wrong[jump + 2 : jump + 200].max() < 0.1
    assert wrong[3500:3550].max() < 0.1


@pytest.mark.parametrize('noise', [1e-7, 1e-5, 1e-4])
@pytest.mark.parametrize('order', [3, 4, 5])
def test_a_moving_y_that_freezes_is_no_jump_of_d(order, noise):
    """It is off by a time, as after a blow, and not by its power `order` (D 33)."""
    rng = np.random.default_rng(order)
    d, t = 0.7 * matern(12_000, 1.5, 2, rng), np.arange(12_000) * PERIOD
    model = np.diag(np.ones(order - 1), 1)
    y = states_of(model, d, [0.2] * order)[:, 0] + noise * rng.standard_normal(len(t))
    y[9_000:9_050] = y[9_000]
    found = Observer(SELF_TUNING, order=order, phi=['0'] * order).run(t, y).unknown_input
    assert np.abs(found - d).max() < 1.5 * np.abs(d).max()


@pytest.mark.parametrize('seed', range(8))
def test_a_y_without_noise_that_is_zero_for_some_samples_is_no_jump_of_d(seed):
    rng = np.random.default_rng(seed)
    d = matern(8_000, 3.0, 1, rng)
    y = states_of(np.array([[0.0, 1.0], [0.0, -5.0]]), d, [0.2, 0.2])[:, 0]
    for begin in range(3_000, len(y), 700):
        y[begin : begin + rng.integers(1, 40)] = 0.0
    found = Observer(MOTOR, phi=['0', '-5*z2']).run(np.arange(len(y)) * PERIOD, y).unknown_input
    assert np.abs(found - d).max() < 1.5 * np.abs(d).max()


@pytest.mark.parametrize('counts', [1024, 4096, 65536])
def test_slow_motion_over_an_encoder(counts):
    """It stands still for most of the time; a count that comes then is no jump of d."""
    t, quantum = np.arange(30_000) * PERIOD, 2.0 * np.pi / counts
    z, d = 0.3 + 0.02 * np.sin(0.5 * t), -0.005 * np.sin(0.5 * t)
    found = Observer(SELF_TUNING, order=2, phi=['0', '0']).run(t, np.round(z / quantum) * quantum)
    wrong = np.abs(found.unknown_input - d)[t > 2.0]
    assert wrong.max() < 2.0 * 0.005
    assert rms(wrong) < rms(d[t > 2.0])


@pytest.mark.parametrize('noise', [0.0, 0.3])
@pytest.mark.parametrize('motion', [0.1, 0.5])
def test_a_quantised_y_of_order_4(motion, noise):
    """Whoever takes each sample that comes again for news is sure of something wrong: 1e5 d."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        y, d, values = chain(4, rng)
        quantum = np.median(np.abs(np.diff(y))) / motion
        y = quantum * np.round(y / quantum + noise * rng.standard_normal(len(y)))
        found = Observer(SELF_TUNING, **values).run(np.arange(len(y)) * PERIOD, y).unknown_input
        assert rms(found - d) < 0.8 * rms(d)
        assert np.abs(found).max() < 2.0 * np.abs(d).max()


@pytest.mark.parametrize('order', [3, 4])
def test_late_stamps_where_y_begins_anew(order):
    """How fast y moves is not known then, nor by what a late stamp puts it off: d was 1e3 d."""
    rng = np.random.default_rng(1)
    y, d, values = chain(order, rng)
    for begin in range(2_500, 8_000, 500):
        y[begin : begin + rng.integers(1, 60)] = 0.0
    t = np.sort(np.arange(len(y)) * PERIOD + rng.exponential(0.1 * PERIOD, len(y)))
    wrong = (estimated(values | SELF_TUNING, t, y).unknown_input - d)[2_000:]
    assert rms(wrong) < rms(d)
    assert np.abs(wrong).max() < 3.0 * np.abs(d).max()


def test_a_covariance_that_rounding_has_spoilt_is_begun_anew():
    """Without an end it would grow, and with it the estimate of a member that nobody believes."""
    recording, values = study('pendulum')
    estimator, stamps = OnlineEstimator(values), stamps_of(recording.t)
    estimator.run(stamps[:4_000], recording.y[:4_000])
    state = estimator.state_dict()
    state['p_zz'][:, ::7] *= -1e30
    estimator.load_state_dict(state)
    found = estimator.run(stamps[4_000:6_000], recording.y[4_000:6_000]).unknown_input
    assert rms(found - recording.d[4_000:6_000]) < 0.5 * rms(recording.d)
    state = estimator.state_dict()
    assert (state['p_zz'][[0, 2]] > 0.0).all()  # the diagonal, of two states


@plants
def test_how_sure_it_is_of_a_quantised_y(plant):
    """A mean over kinds of d; with one of the seeds members had once narrowed without end."""
    inside = []
    for kind in ('sine', 'chirp', 'ou', 'square', 'pulses'):
        r, values = study(plant, CONDITIONS['y in steps of 5 sigma'], kind, seed=3)
        found = observed(values, r)
        d, deviation = found.unknown_input, found.standard_deviation
        late = r.t > 3.0
        wrong = np.abs(d - r.d)[late]
        assert rms(wrong) < 1.2 * rms(r.d[late])
        inside.append(np.mean(wrong < deviation[late, -1]))
    assert 0.5 < np.mean(inside) < 0.9


@plants
def test_a_sensor_that_is_stuck_at_the_end_of_its_range_or_not_ready(plant):
    """Believed, that would be a plant that stands still."""
    r, values = study(plant)
    late = r.t > 5.0
    clipped = np.clip(r.y, *np.quantile(r.y, [0.05, 0.95]))
    stuck = np.where((r.t > 8.0) & (r.t < 8.3), r.y[8001], r.y)
    for y in (clipped, stuck, np.where(r.t < 2.0, 0.0, r.y)):
        estimator = OnlineEstimator(values)
        found = estimator.run(stamps_of(r.t), y).unknown_input
        repeated = np.count_nonzero(np.diff(y)[4000:] == 0.0)  # many once, near the range's end
        assert 0.6 * repeated <= estimator.counters.rejected_stuck
        assert rms((found - r.d)[late]) < 0.5 * rms(r.d)
        assert np.abs(found).max() < 50.0 * np.abs(r.d).max()


@pytest.mark.parametrize('late', [0.0, 2e-4], ids=['exact', 'late stamps'])
def test_a_simulated_y_without_noise_that_comes_to_rest_is_not_stuck(late):
    t = np.arange(16_000) * PERIOD
    slow = np.cumsum(np.cos(2.0 * t) * np.where(t < 8.0, 1.0, np.exp(48.0 - 6.0 * t))) * PERIOD
    sudden = np.sin(2.0 * np.minimum(t, 8.3))
    stamps = t + late * np.abs(np.random.default_rng(0).standard_normal(len(t)))
    for y in (slow, sudden):
        run = estimated({'order': 2, 'phi': ['0', '-z2'], **SELF_TUNING}, np.sort(stamps), y)
        assert not np.any(run.status & (Status.REPEATED | Status.REJECTED_STUCK))
        assert np.count_nonzero(np.diff(y) == 0.0) > 1000


@plants
@pytest.mark.parametrize(('samples', 'noise'), [(5, 1.0), (10, 1.0), (10, 0.0), (20, 1.0)])
def test_a_sensor_that_is_slower_than_its_topic(plant, samples, noise):
    """It repeats each value; believed, that would be a d that jumps with each new one."""
    r, values = study(plant)
    noise *= PLANTS[plant].noise
    y = r.z[:, 0] + noise * np.random.default_rng(9).standard_normal(len(r.t))
    run = estimated(values, r.t, y[np.arange(len(y)) // samples * samples])
    late, every = r.t > 10.0, slice(None, None, samples)
    alone = estimated(values, r.t[every], y[every])
    expected = rms((alone.unknown_input - r.d[every])[late[every]])
    repeats = (run.status & Status.REPEATED) > 0
    assert np.mean(repeats[late]) == pytest.approx(1.0 - 1.0 / samples, abs=1e-3)
    assert rms((run.unknown_input - r.d)[late & ~repeats]) < 1.5 * expected + 0.1 * rms(r.d)


def test_y_that_stands_still_says_no_more_with_every_sample():
    """
    Of a constant y nothing is guessed before it moves.

    Then a member's z1 has a deviation of at most half a quantum, and 0.29 q if it is as likely
    everywhere in it.
    """
    y, t = np.full(23_000, 0.3), np.arange(23_000) * PERIOD
    y[3000:3100] += 0.001 * (np.arange(100) // 10 % 2)
    observer = Observer({'order': 2, 'phi': ['0', '0'], **SELF_TUNING})
    constant = observer.run(t[:3000], y[:3000])
    assert (constant.unknown_input == 0.0).all()
    assert np.isinf(constant.standard_deviation[-1, -1])
    assert math.isnan(observer.tuning.noise)
    deviation = observer.run(t[3000:], y[3000:]).standard_deviation[1000:, 0] / 0.001
    assert 0.1 < deviation.min() <= deviation.max() < 0.55


@pytest.mark.parametrize(('name', 'kind', 'seed'), [
    ("paper's plant", 'sine', 20), ('motor', 'ou', 14), ('pendulum', 'square', 3),
])  # fmt: skip
def test_noise_that_grows_is_not_taken_for_a_jump_of_d(name, kind, seed):
    """A hundredfold noise has samples farther and farther off by chance (D 33)."""
    r, values = study(name, Condition(later=100.0), kind, 8.0, seed)
    found = observed(values, r).unknown_input
    assert np.abs(found - r.d).max() < 4.0 * np.abs(r.d).max()


def test_known_input_and_a_constant_that_changes_live():
    """Members of a linear model keep what it makes of them in a period: of the new one then."""
    t = np.arange(20_000) * PERIOD
    d, u = 70.0 * np.sin(3.0 * t), 50.0 * np.sign(np.sin(2.0 * t))
    y = states_of(np.array([[0.0, 1.0], [0.0, -5.0]]), d + 5.0 * np.append(u[1:], 0.0))[:, 0]
    y += 1e-4 * np.random.default_rng(8).standard_normal(len(t))
    observer = Observer(SELF_TUNING, order=2, phi=['0', '5*u - b*z2'], constants={'b': 25.0})
    observer.run(t[:8000], y[:8000], u[:8000])
    observer.configure({'constants.b': 5.0})
    run = observer.run(t[8000:], y[8000:], u[8000:])
    flow = observer.structure.state_dict()['flow']
    assert flow[1, 1] == pytest.approx(math.exp(-5.0 * PERIOD), rel=1e-6)
    assert rms((run.unknown_input - d[8000:])[4000:]) < 0.02 * rms(d)


def members_of(values):
    """Return the members' states (N, 240) and covariances (N, N, 240), by a snapshot."""
    n = len(values['z'])
    p = np.zeros((n + 4, n + 4, 240))
    p[:n, n:], p[n:, n:] = values['p_zd'], values['p_dd']
    p[np.tril_indices(n)[::-1]] = values['p_zz']  # column by column
    upper = np.triu_indices(n + 4, 1)
    p[upper[::-1]] = p[upper]
    return np.concatenate([values['z'], values['d']]), p


def filtered(y, h, rates, intensity, variance, x, p):
    """Return estimate and covariance of a textbook Kalman filter."""
    drive = np.zeros_like(rates)
    drive[-1, -1] = intensity
    a, _ = discrete(rates, drive, h)
    _, q = discrete(np.eye(len(rates), k=1), drive, h)  # that of integrators (D 20)
    for measured in y:
        x, p = a @ x, a @ p @ a.T + q
        gain = p[:, 0] / (p[0, 0] + variance)
        x, p = x + gain * (measured - x[0]), p - np.outer(gain, p[0])
    return x, p


@pytest.mark.parametrize('stretch', [1.0, 1.2])
def test_members_with_white_noise_are_kalman_filters(case, stretch):
    """State and covariance of members of every k, while no innovation is large."""
    t, z, _, noise = case
    y = z[:, 0] + 1e-3 * np.where(t < 0.3, noise, 0.3 * noise)
    observer = Observer(SELF_TUNING)
    observer.run(t[:300], y[:300])
    values = observer.structure.state_dict()
    kappa, (x, covariances) = values['kappa'], members_of(values)
    samples, h = y[300:315], stretch * PERIOD
    for measured in samples:
        observer.step(measured, h)
    after_x, after_covariances = members_of(observer.structure.state_dict())
    resting = (covariances == after_covariances).all((0, 1))[:120].sum()
    derivatives = np.tile([0, 1, 3], 80)
    for k in (0, 1, 3):
        scores = np.where((np.arange(240) < 120) & (k == derivatives), values['score'], -np.inf)
        scores[: resting + 2 * 3] = -np.inf
        g = np.argmax(scores)
        size = 4 + k
        first, covariance = x[:size, g], covariances[:size, :size, g]
        rates = np.eye(size, k=1)
        rates[2, 2] = -1.0
        rates[range(3, size), range(3, size)] = -kappa[g]
        drive, variance = values['drive'][k, g], values['used_noise'][0]
        found, expected = filtered(samples, h, rates, drive, variance, first, covariance)
        wrong = np.abs(after_x[:size, g] - found) / np.sqrt(np.diag(expected))
        assert wrong.max() < 1e-6, k
        np.testing.assert_allclose(after_covariances[:size, :size, g], expected, rtol=1e-6)


@pytest.mark.parametrize('noise', [1e-4, 1e-3])
@pytest.mark.parametrize(('shape', 'omega'), [('sine', 1.0), ('sine', 4.0), ('square', 1.0)])
def test_it_does_what_the_plain_version_does(shape, omega, noise):
    """Where noise is white and stamps are even, the idea is all that acts."""
    t = 2e-3 * np.arange(5000)
    truth = Plant(disturbance=shape, disturbance_omega=omega).simulate(t)
    y = truth.y + noise * np.random.default_rng(3).standard_normal(len(t))
    model = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    plain = plain_estimate(model, y, 2e-3)
    found = Observer(order=3, phi=['0', '0', '-z3'], **SELF_TUNING).run(t, y)
    late = t > 3.0
    error = rms((found.unknown_input - truth.unknown_input)[late])
    assert rms((plain.d - found.unknown_input)[late]) < 0.2 * error
    between = np.median(plain.deviation[late] / found.standard_deviation[late, -1])
    assert between == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize('width', [1e-6, 0.02, 0.04, 0.5, 2.0, 9.0, 30.0])
@pytest.mark.parametrize('middle', [-5.0, -1.3, 0.0, 0.4, 3.0, 5.0])
def test_moments_of_a_truncated_normal_distribution(middle, width):
    low, high = middle - 0.5 * width, middle + 0.5 * width
    chance, mean, lost = within(low, high)
    with np.errstate(all='ignore'):
        expected = truncnorm.stats(low, high, moments='mv')
    np.testing.assert_allclose([mean, 1.0 - lost], expected, rtol=1e-3, atol=1e-4)
    share = norm.cdf(high) - norm.cdf(low) if middle < 0.0 else norm.sf(low) - norm.sf(high)
    least = -4.5  # of quantised samples (D 31)
    np.testing.assert_allclose(chance, max(math.log(share), least), atol=1e-3)
    sign = math.copysign(1.0, middle)  # far off an interval counts as its nearer end
    chance, mean, _ = within(*sorted((sign * 20.0, sign * 21.0)))
    assert 20.0 <= sign * mean <= 20.1
    assert chance == least


def test_outliers_do_not_hide_the_quanta():
    """Steps to them are no multiples; taken for the quantum, y would be smooth for ever."""
    t, clean, d = swept()
    clean = np.round(clean / 1.5e-3) * 1.5e-3
    expected = rms((Observer(MOTOR).run(t, clean).unknown_input - d)[5000:])
    y = clean.copy()
    for k in range(10, len(t), 700):  # the first one before the members begin
        y[k : k + 15] += 0.0224 * (-1) ** k
    run = Observer(MOTOR).run(t, y)
    assert rms((run.unknown_input - d)[5000:]) < 1.5 * expected
