# SPDX-License-Identifier: Apache-2.0
"""Estimates from the samples before and after: theorems of smoothing, faults of data, lags."""

import math

from fhaosmo_ros.core import Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.observer import smoother
from fhaosmo_ros.core.observer.kalman import INPUT_DOUBT, STATES_DOUBT
from fhaosmo_ros.core.observer.status import REJECTED, Status
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.tuning.tuner import stamps_of
import numpy as np
from observer_cases import discrete, matern, states_of
import pytest
from scipy.linalg import solve_continuous_lyapunov

CONFIG = 'config/noise_1e-3.yaml'
MS = 1_000_000
NOISE = 1e-3
SELF_TUNING = {'gains': 'self_tuning', 'order': 2, 'phi': ['0', '-3*z2']}
RATES = np.array([[0.0, 1.0], [0.0, -3.0]])


def recording(seconds):
    """Return t, y and d of the paper's plant."""
    t = np.arange(0.0, seconds, 1e-3)
    truth = Plant(disturbance_omega=2.0).simulate(t)
    return t, truth.y + np.random.default_rng(3).normal(0.0, NOISE, len(t)), truth.unknown_input


def online(gains='fixed', **changes):
    """Return an estimator with the gains for this noise, or without gains."""
    own = OnlineEstimator.from_yaml(CONFIG).parameters if gains == 'fixed' else SELF_TUNING
    return OnlineEstimator({**own, **changes})


def smoothed(estimator, stamps, y, u=None, size=10**5):
    """Return the rows that an estimator smooths of a recording in parts, and those that waited."""
    if estimator.smoothing is None:
        estimator.smooth()
    parts = [slice(k, k + size) for k in range(0, len(y), size)]
    rows = [estimator.run(stamps[k], y[k], None if u is None else u[k]) for k in parts]
    rows.append(estimator.finish())
    for row in rows:
        assert np.isfinite([*row.z.ravel(), *row.unknown_input]).all()
        assert not np.isnan(row.standard_deviation).any()
    return rows


def joined(rows, name='unknown_input'):
    return np.concatenate([getattr(row, name) for row in rows])


def of_matern(count, noise=NOISE):
    """Return t and y of a plant whose d is a Matern process with a derivative."""
    rng = np.random.default_rng(1)
    y = states_of(RATES, matern(count, 4.0, 1, rng))[:, 0]
    return np.arange(count) * 1e-3, y + noise * rng.standard_normal(count)


both = pytest.mark.parametrize('gains', ['fixed', 'self'])


def expect_textbook(found, observer, y, steps, model, sizes, share=1.0):
    """
    Compare with the smoother of Rauch, Tung and Striebel, and return its standard deviations.

    Written from the book, with exact matrices. `model` is the variance of the noise, the
    intensity of what drives the last derivative of d, kappa, and the number of these derivatives;
    at the start the states have deviations of `sizes`, d a `share` of its usual one. A y of NaN
    is no sample.
    """
    variance, drive, kappa, k = model
    n, before = observer.order, None
    size = n + 1 + int(k)
    a, q, p = np.eye(size, k=1), np.zeros((size, size)), np.zeros((size, size))
    a[:n, :n] += observer.model.jacobian(np.zeros(n))
    a[range(n, size), range(n, size)] = -kappa
    q[-1, -1] = drive
    p[range(n), range(n)] = np.square(sizes)
    p[0, 0] = variance
    p[n:, n:] = share**2 * solve_continuous_lyapunov(a[n:, n:], -q[n:, n:])
    x = np.append(y[0], np.zeros(size - 1))
    passed = []
    for h, sample in zip(steps, y[1:], strict=True):
        if h != before:
            (f, noise), before = discrete(a, q, h), h
        passed.append((x, p, f @ x, f @ p @ f.T + noise, f))
        x, p = passed[-1][2:4]
        if np.isfinite(sample):
            gain = p[:, 0] / (p[0, 0] + variance)
            x, p = x + gain * (sample - x[0]), p - np.outer(gain, p[0])
    rows = [(x, p)]
    for xf, pf, xp, pp, f in reversed(passed):
        scale = np.sqrt(np.diag(pp))  # the inverse in units that are alike
        c = pf @ f.T / scale @ np.linalg.inv(pp / np.outer(scale, scale)) / scale
        x, p = xf + c @ (x - xp), pf + c @ (p - pp) @ c.T
        rows.append((x, p))
    known = np.array([(x, np.sqrt(np.diag(p))) for x, p in rows[::-1]])[..., : n + 1]
    ours = np.column_stack([found.z, found.unknown_input])
    assert np.abs((ours - known[:, 0]) / known[:, 1]).max() < 0.02
    return known[:, 1]


@pytest.mark.parametrize('steps', ['even', 'irregular', 'missing'])
def test_it_is_the_smoother_of_rauch_tung_and_striebel(steps):
    h = np.full(2500, 1e-3)
    if steps == 'irregular':
        h = np.random.default_rng(5).uniform(0.2e-3, 3e-3, 2500)
        h[1000] = 0.04
    t = np.cumsum(h)
    truth = Plant({'disturbance_omega': 2.0}).simulate(np.arange(0.0, t[-1] + 1e-3, 1e-4))
    y = np.interp(t, np.arange(len(truth.y)) * 1e-4, truth.y)
    y += NOISE * np.random.default_rng(1).uniform(-1.7, 1.7, len(t))  # Huber's weights are 1
    if steps == 'missing':
        y[600:640] = y[1200] = np.nan
    observer = Observer.from_yaml(CONFIG)
    found, p = observer.smooth(t, y), observer.parameters
    k, kappa = p['unknown_input_derivatives'], p['unknown_input_decay']
    density = (2 * kappa) ** (2 * k + 1) * math.factorial(k) ** 2 / math.factorial(2 * k)
    model = p['noise_size'] ** 2, p['unknown_input_size'] ** 2 * density, kappa, k
    sizes = STATES_DOUBT * np.array(p['state_sizes'])
    expect_textbook(found, observer, y, h[1:], model, sizes, INPUT_DOUBT)


def test_it_is_that_smoother_with_self_tuning_gains():
    """A recording that ends before the observer is believed has one model, that of its end."""
    t, y = of_matern(900, noise=0.0)
    y += NOISE * np.random.default_rng(2).uniform(-1.7, 1.7, len(t))
    observer = Observer(SELF_TUNING)
    found = observer.smooth(t, y)
    known = found.z_hat[np.argmax(found.model[:, 1] > 0.0)]
    sizes = STATES_DOUBT * np.maximum(observer.parameters['state_sizes'], np.abs(known[:2]))
    steps = np.full(len(t) - 1, 1e-3)
    deviations = expect_textbook(found, observer, y, steps, found.model[-1], sizes)
    np.testing.assert_allclose(found.standard_deviation, deviations, rtol=0.02)


def test_the_longer_the_lag_the_nearer_to_the_whole():
    t, y, d = recording(12.0)
    stamps, judged = stamps_of(t), slice(2000, 9000)
    whole = Observer.from_yaml(CONFIG).smooth(t, y).unknown_input
    filtered = rms((online().run(stamps, y).unknown_input - d)[judged])
    assert rms((whole - d)[judged]) < 0.4 * filtered
    differences = []
    for lag in (0.3, 1.0, 2.5):
        lagging = online(smoothing_lag=lag).run(stamps, y)
        assert lagging.t[-1] == stamps[-1] - round(lag * 1e9)
        differences.append(np.abs(lagging.unknown_input[judged] - whole[judged]).max())
    # What still comes counts for less and less, exponentially.
    assert differences[2] < 0.05 * differences[1] < 0.05 * 0.3 * differences[0]


@both
def test_a_recording_in_parts_is_the_same(gains, monkeypatch):
    t, y = recording(12.0)[:2] if gains == 'fixed' else of_matern(12_000)
    observer = Observer(SELF_TUNING) if gains == 'self' else Observer.from_yaml(CONFIG)
    whole, rough = observer.smooth(t, y), 1e-5 if gains == 'self' else 0.0
    monkeypatch.setattr(smoother, 'BLOCK', 1500)
    rows = smoothed(online(gains), stamps_of(t), y, size=700)
    assert 0 < max(len(row.t) for row in rows[:-1]) < 6000  # handed out meanwhile
    for name in ('unknown_input', 'standard_deviation'):
        wanted = getattr(whole, name)
        for found in (joined(rows, name), getattr(observer.smooth(t, y), name)):
            np.testing.assert_allclose(found, wanted, rtol=rough, atol=0.1 * rough + 1e-7)


@both
def test_one_by_one_is_the_same_as_a_run(gains):
    t, y = recording(2.0)[:2] if gains == 'fixed' else of_matern(3000)
    y[1100:1110] = np.nan
    y[1250] += 1.0
    stamps = stamps_of(t)
    stamps[1500:] += 2 * 10**9  # beyond max_gap
    many, one = (online(gains, smoothing_lag=0.1) for _ in range(2))
    rows = many.run(stamps, y)
    told = np.column_stack([rows.unknown_input, rows.standard_deviation, rows.tuning])
    known = dict(zip(rows.t.tolist(), told, strict=True))
    published = set()
    for stamp, sample in zip(stamps.tolist(), y.tolist(), strict=True):
        estimate = one.update(stamp, sample)
        assert (estimate is None) == (one.stamp is None)
        if estimate is not None:
            its = np.hstack([estimate.unknown_input, one.standard_deviation, *one.tuning])
            np.testing.assert_array_equal(known[one.stamp], its[: len(told[0])])
            assert one.stamp <= stamp - 100 * MS
            published.add(one.stamp)
    # Rows before a restart become final with it; live ones are too old then.
    assert len(rows.t) - 300 < len(published) < len(rows.t)
    assert one.stamp == stamps[-1] - 100 * MS


@pytest.mark.parametrize('reset', [False, True])
def test_nothing_is_smoothed_across_a_restart(reset):
    t, y, _ = recording(4.0)
    stamps, estimator = stamps_of(t), online()
    theirs = joined(smoothed(online(), stamps, y))
    estimator.smooth()
    rows = [estimator.run(stamps, y)]
    if reset:
        estimator.reset()
    ours = joined(rows + smoothed(estimator, stamps + 10**10, 5.0 + y))
    np.testing.assert_allclose(ours[: len(theirs)], theirs, rtol=0.0, atol=1e-9)
    assert len(ours) == 2 * len(t) - (not reset)  # the sample that announced the restart


@pytest.mark.parametrize(('fault', 'bar'), [('outliers', 1.3), ('jump', 3.0), ('stays', 3.0)])
def test_outliers_and_jumps_of_y_alone_hardly_matter(fault, bar):
    t, y, d = recording(8.0)
    judged, observer = slice(2000, 6000), Observer.from_yaml(CONFIG)
    clean = rms((observer.smooth(t, y).unknown_input - d)[judged])
    if fault == 'outliers':
        bad = np.random.default_rng(2).choice(len(y), len(y) // 50, replace=False)
        y[bad] += np.random.default_rng(3).normal(0.0, 0.3, len(bad))
    else:
        y[4000 : 4500 if fault == 'jump' else None] += 5.0
    found = observer.smooth(t, y)
    assert rms((found.unknown_input - d)[judged]) < bar * clean
    if fault != 'outliers':
        assert (found.status & Status.JUMPED).any()
        assert np.abs((found.z[:, 0] - y)[4100:4400]).max() < 3.0 * NOISE
    used = (found.status & REJECTED) == 0
    parts = joined(smoothed(online(), stamps_of(t), y, size=13))
    np.testing.assert_allclose(parts, found.unknown_input[used], rtol=0.0, atol=0.1 * clean)


def test_a_jump_of_d_is_seen_where_it_is():
    """The estimate changes within some samples of the jump, and not before."""
    t = np.arange(6000) * 1e-3
    d = np.where(t < 4.0, 0.0, 50.0)
    y = states_of(RATES, d)[:, 0] + 1e-5 * np.random.default_rng(4).standard_normal(len(t))
    found = Observer(SELF_TUNING).smooth(t, y)
    assert np.abs(found.unknown_input[2000:3950]).max() < 5.0
    assert np.abs(found.unknown_input[4100:5900] - 50.0).max() < 5.0


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_a_quick_d_that_comes_back_is_not_taken_for_noise(seed):
    """An oscillator whose force pauses for 500 samples; it moves y about as quickly as noise."""
    rng, period, fine = np.random.default_rng(seed), 1.6384e-3, 10
    t = np.arange(3000 * fine) * period / fine
    omega, phase = rng.uniform(60.0, 600.0, 40), rng.uniform(0.0, 2.0 * np.pi, 40)
    d = np.sin(np.outer(t, omega) + phase).sum(axis=1)
    d *= 4e3 / d.std()
    d[1500 * fine : 2000 * fine] = 0.0
    z = states_of(np.array([[0.0, 1.0], [-184e3, -42.0]]), d, period=period / fine)
    y, d = z[::fine, 0] + 1e-4 * rng.standard_normal(3000), d[::fine]
    stamps = stamps_of(np.arange(1, len(y) + 1) * period)
    found = online('self', phi=['0', '-184e3*z1 - 42*z2'], smoothing_lag=0.01).run(stamps, y)
    d_of = d[np.searchsorted(stamps, found.t)]  # not every sample is used
    assert rms((found.unknown_input - d_of)[found.t > stamps[2200]]) < 0.2 * rms(d)


def test_known_inputs_and_a_nonlinear_model():
    phi = ['0', '-19.62*sin(z1) - 0.3*z2 - 0.5*tanh(z2/0.1) + u']
    t = np.arange(0.0, 8.0, 1e-3)
    u = 5.0 * np.sin(7.0 * t) * (np.sin(1.3 * t) > 0)
    model = {'order': 2, 'phi': phi, 'initial_state': [0.5, 0.0], 'disturbance_amplitude': 4.0}
    truth = Plant(model).simulate(t, u)
    y = truth.y + 5e-4 * np.random.default_rng(4).standard_normal(len(t))
    own = Observer.from_yaml('config/models/pendulum.yaml').parameters
    observer, judged = Observer(own | {'phi': phi}), slice(1500, 7000)
    found = observer.run(t, y, u), observer.smooth(t, y, u)
    run, smooth = (rms((f.unknown_input - truth.unknown_input)[judged]) for f in found)
    assert smooth < 0.35 * run


def test_what_is_missing_is_told_in_one_line():
    with pytest.raises(ConfigurationError, match=r"expected 'noise_size' > 0.*got 0 and true"):
        Observer().smooth(np.arange(9.0), np.zeros(9))
    estimator = online(smoothing_lag=0.1)
    with pytest.raises(ConfigurationError, match="'noise_size'"):
        estimator.configure({'noise_size': 0.0})


def test_where_only_y_is_known_the_rest_is_unknown():
    """A constant y says nothing of its noise."""
    rows = smoothed(online('self'), np.arange(1, 2001) * MS, np.full(2000, 0.5))
    assert len(joined(rows)) == 2000
    assert np.isinf(rows[1].standard_deviation[:, 1:]).all()
    np.testing.assert_array_equal(rows[1].z[:, 0], 0.5)


@pytest.mark.parametrize('seed', [0, 1, 2, 13])
@both
def test_any_data_gives_finite_estimates(gains, seed):
    """Outliers among the first samples, inputs beyond all numbers, a model without a limit."""
    random, count = np.random.default_rng(seed), 3000
    u = np.where(np.arange(count) // 5 == 200, 1e308, 0.0)
    y = random.standard_normal(count).cumsum()
    y[random.random(count) < 0.05] = np.nan
    y[random.random(count) < 0.02] = 1e8
    stamps = random.integers(-MS, 4 * MS, count).cumsum() + 10**12
    stamps[random.random(count) < 0.01] += 3 * 10**9
    t = (np.sort(stamps) + np.arange(count)) * 1e-9
    for last in (['0', 'u - 3*z2'], ['0', 'sin(z1) - z2*abs(z2)']):
        phi = last if gains == 'self' else ['0', *last]
        own = online(gains, phi=phi).observer.parameters
        assert np.isfinite(Observer(own).smooth(t, y, u).unknown_input).all()
        for lag in (0.0, 0.05):
            estimator = online(gains, phi=phi, smoothing_lag=lag)
            smoothed(estimator, stamps[:2000], y[:2000], u[:2000])
            estimator.reset()
            smoothed(estimator, stamps[2000:], y[2000:], u[2000:])
