# SPDX-License-Identifier: Apache-2.0
"""Estimates of the past with self-tuning gains: theorems of smoothing, bands, faults of data."""

import math

from fhaosmo_ros.core import Observer, OnlineEstimator
from fhaosmo_ros.core.observer.kalman import STATES_DOUBT
import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

MS = 1_000_000
SELF_TUNING = {'gains': 'self_tuning', 'order': 2, 'phi': ['0', '-3*z2']}
RATES = np.array([[0.0, 1.0], [0.0, -3.0]])


def respond(rates, d, period):
    """Return z of z' = A z + e_2 d, which begins at rest; d is held between the samples."""
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[1, 2] = rates, 1.0
    step, z = expm(whole * period), np.zeros((len(d), 2))
    for k in range(1, len(d)):
        z[k] = step[:2, :2] @ z[k - 1] + step[:2, 2] * d[k - 1]
    return z


def recording(seconds, noise=1e-3, bandwidth=4.0, seed=1):
    """Return t, y and the truth of d, a Matern process with a derivative."""
    rng = np.random.default_rng(seed)
    count = round(seconds * 1e3)
    d = rng.standard_normal(count + 5000)
    share = math.exp(-bandwidth * 1e-3)
    for _ in range(2):
        for k in range(1, len(d)):
            d[k] += share * d[k - 1]
    d = d[5000:] / d[5000:].std()
    y = respond(RATES, d, 1e-3)[:, 0] + noise * rng.standard_normal(count)
    return np.arange(count) * 1e-3, y, d


def online(**changes):
    return OnlineEstimator(SELF_TUNING | changes)


def stamps_of(t):
    return np.round(t * 1e9).astype(np.int64) + MS


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def textbook(run, y):
    """
    Return the smoother of Rauch, Tung and Striebel and its deviations, from exact matrices.

    The model of d and the noise are those that the observer finds likeliest at the end.
    """
    variance, drive, kappa, k = run.model[-1]
    last = 2 + int(k)
    a = np.zeros((5, 5))
    a[:2, :2], a[1, 2] = RATES, 1.0
    a[2:, 2:] = -kappa * np.eye(3) + np.eye(3, k=1)
    q = np.zeros((5, 5))
    q[last, last] = drive
    whole = expm(np.block([[-a, q], [np.zeros((5, 5)), a.T]]) * 1e-3)
    f = whole[5:, 5:].T
    q = f @ whole[:5, 5:]
    known = run.z_hat[np.argmax(run.model[:, 1] > 0.0)]
    size = max(Observer(SELF_TUNING).parameters['state_sizes'][0], abs(known[1]))
    p = np.diag([variance, (STATES_DOUBT * size) ** 2, 0.0, 0.0, 0.0])
    chain = slice(2, last + 1)
    noise = np.zeros((last - 1, last - 1))
    noise[-1, -1] = drive
    p[chain, chain] = solve_continuous_lyapunov(a[chain, chain], -noise)
    x = np.array([y[0], 0.0, 0.0, 0.0, 0.0])
    filtered, predicted = [(x, p)], []
    for sample in y[1:]:
        x, p = f @ x, f @ p @ f.T + q
        predicted.append((x, p))
        gain = p[:, 0] / (p[0, 0] + variance)
        x, p = x + gain * (sample - x[0]), p - np.outer(gain, p[0])
        filtered.append((x, p))
    used = slice(0, last + 1)  # P of derivatives behind `last` is 0
    x, p = (part[used] if part.ndim == 1 else part[used, used] for part in filtered[-1])
    f = f[used, used]
    means, deviations = [x], [np.sqrt(np.diag(p))]
    for (xf, pf), (xp, pp) in zip(filtered[-2::-1], predicted[::-1], strict=True):
        xf, pf, xp, pp = xf[used], pf[used, used], xp[used], pp[used, used]
        scale = np.sqrt(np.diag(pp))  # the inverse in units that are alike
        gain = pf @ f.T / scale @ np.linalg.inv(pp / np.outer(scale, scale)) / scale
        x, p = xf + gain @ (x - xp), pf + gain @ (p - pp) @ gain.T
        means.append(x)
        deviations.append(np.sqrt(np.diag(p)))
    return np.array(means[::-1]), np.array(deviations[::-1])


def test_it_is_the_smoother_of_rauch_tung_and_striebel():
    """A recording that ends before the observer is believed has one model, that of its end."""
    t, y, _ = recording(0.9, noise=0.0)
    y = y + 1e-3 * np.random.default_rng(2).uniform(-1.7, 1.7, len(t))  # Huber's weights are 1
    observer = Observer(SELF_TUNING)
    found = observer.smooth(t, y)
    means, deviations = textbook(found, y)
    ours = np.column_stack([found.z, found.unknown_input])
    assert np.abs((ours - means[:, :3]) / deviations[:, :3]).max() < 0.02
    np.testing.assert_allclose(found.standard_deviation, deviations[:, :3], rtol=0.02)


def test_more_of_the_future_is_better_and_the_band_holds():
    errors, inside = [], []
    for seed in range(3):
        t, y, d = recording(15.0, seed=seed)
        judged, stamps = slice(3000, 14_000), stamps_of(t)
        found = [online().run(stamps, y)]
        for lag in (0.05, 0.3):
            found.append(online(smoothing_lag=lag).run(stamps, y))
        found.append(Observer(SELF_TUNING).smooth(t, y))
        wrong = [f.unknown_input[judged] - d[judged] for f in found]
        errors.append([rms(e) for e in wrong])
        inside.append(
            [
                [
                    np.mean(np.abs(e) < width * f.standard_deviation[judged, -1])
                    for width in (1.0, 2.0)
                ]
                for e, f in zip(wrong, found, strict=True)
            ]
        )
    errors = np.mean(errors, axis=0)
    assert errors[1] < errors[0]
    assert errors[2] < 0.7 * errors[0]
    assert errors[3] < 0.7 * errors[0]
    narrow, wide = np.mean(inside, axis=0).T
    assert (narrow > 0.5).all()
    assert (narrow < 0.85).all()
    assert (wide > 0.75).all()


def test_one_by_one_is_the_same_as_a_run():
    t, y, _ = recording(3.0)
    y[1700:1710] = np.nan
    y[1900] += 1.0
    stamps = stamps_of(t)
    stamps[2400:] += 2 * 10**9  # beyond max_gap
    many, one = online(smoothing_lag=0.1), online(smoothing_lag=0.1)
    rows = many.run(stamps, y)
    known = {
        stamp: (d, *deviation)
        for stamp, d, deviation in zip(
            rows.t.tolist(), rows.unknown_input.tolist(), rows.standard_deviation, strict=True
        )
    }
    told = 0
    for stamp, sample in zip(stamps.tolist(), y.tolist(), strict=True):
        estimate = one.update(stamp, sample)
        if estimate is not None:
            assert known[one.stamp] == (estimate.unknown_input, *one.standard_deviation)
            told += 1
    assert told > 2000


def test_a_recording_in_parts_is_the_same():
    t, y, _ = recording(12.0)
    whole = Observer(SELF_TUNING).smooth(t, y)
    estimator = online()
    estimator.smooth()
    stamps = stamps_of(t)
    rows = [estimator.run(stamps[k : k + 700], y[k : k + 700]) for k in range(0, len(t), 700)]
    rows.append(estimator.finish())
    for name in ('unknown_input', 'standard_deviation'):
        found = np.concatenate([getattr(row, name) for row in rows])
        np.testing.assert_allclose(found, getattr(whole, name), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize('lag', [0.0, 0.05])
def test_where_only_y_is_known_the_rest_is_unknown(lag):
    """A constant y says nothing of its noise."""
    stamps = np.arange(1, 2001) * MS
    estimator = online(smoothing_lag=lag)
    if not lag:
        estimator.smooth()
    rows = [estimator.run(stamps, np.full(2000, 0.5)), estimator.finish()]
    assert sum(len(row.t) for row in rows) == 2000
    assert np.isinf(rows[1].standard_deviation[:, 1:]).all()
    np.testing.assert_array_equal(rows[1].z[:, 0], 0.5)


def test_a_jump_of_d_is_seen_where_it_is():
    """The estimate changes within some samples of the jump, and not before."""
    t = np.arange(6000) * 1e-3
    d = np.where(t < 4.0, 0.0, 50.0)
    y = respond(RATES, d, 1e-3)[:, 0] + 1e-5 * np.random.default_rng(4).standard_normal(len(t))
    found = Observer(SELF_TUNING).smooth(t, y)
    assert np.abs(found.unknown_input[2000:3950]).max() < 5.0
    assert np.abs(found.unknown_input[4100:5900] - 50.0).max() < 5.0


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_a_quick_d_that_comes_back_is_not_taken_for_noise(seed):
    """An oscillator whose force pauses for 500 samples; it moves y about as quickly as noise."""
    rng, period, fine, pause = np.random.default_rng(seed), 1.6384e-3, 10, slice(1500, 2000)
    t = np.arange(3000 * fine) * period / fine
    omega, phase = rng.uniform(60.0, 600.0, 40), rng.uniform(0.0, 2.0 * np.pi, 40)
    d = np.sin(np.outer(t, omega) + phase).sum(axis=1)
    d *= 4e3 / d.std()
    d[pause.start * fine : pause.stop * fine] = 0.0
    z = respond(np.array([[0.0, 1.0], [-184e3, -42.0]]), d, period / fine)
    y, d = z[::fine, 0] + 1e-4 * rng.standard_normal(3000), d[::fine]
    stamps = np.round(np.arange(1, len(y) + 1) * period * 1e9).astype(np.int64)
    found = online(phi=['0', '-184e3*z1 - 42*z2'], smoothing_lag=0.01).run(stamps, y)
    number = np.searchsorted(stamps, found.t)
    late = number > pause.stop + 200
    assert rms(found.unknown_input[late] - d[number[late]]) < 0.2 * rms(d)


@pytest.mark.parametrize('lag', [0.0, 0.05])
def test_an_input_beyond_all_numbers_is_forgotten(lag):
    """The observer rejects it or begins afresh; its own estimates stand where no number can."""
    y = 1e-3 * np.random.default_rng(1).standard_normal(3000)
    u = np.zeros(3000)
    u[2000:2005] = 1e308
    estimator = online(phi=['0', 'u - 3*z2'], smoothing_lag=lag)
    if not lag:
        estimator.smooth()
    rows = [estimator.run(MS * np.arange(1, 3001), y, u), estimator.finish()]
    for row in rows:
        assert np.isfinite(row.z).all()
        assert np.isfinite(row.unknown_input).all()
        assert not np.isnan(row.standard_deviation).any()
    d = np.concatenate([row.unknown_input for row in rows])
    assert len(d) > 2990
    assert np.abs(d[-900:]).max() < 10.0


@pytest.mark.parametrize('seed', [0, 1, 2, 13])
def test_any_data_gives_finite_estimates(seed):
    """Also where outliers are among the first samples, and the model grows without a limit."""
    random = np.random.default_rng(seed)
    count = 3000
    y = random.standard_normal(count).cumsum()
    y[random.random(count) < 0.05] = np.nan
    y[random.random(count) < 0.02] = 1e8
    stamps = random.integers(-MS, 4 * MS, count).cumsum() + 10**12
    stamps[random.random(count) < 0.01] += 3 * 10**9
    for phi in (['0', '-3*z2'], ['0', 'sin(z1) - z2*abs(z2)']):
        for lag in (0.0, 0.05):
            estimator = online(phi=phi, smoothing_lag=lag)
            if not lag:
                estimator.smooth()
            rows = [estimator.run(stamps[:2000], y[:2000])]
            estimator.reset()
            rows += [estimator.run(stamps[2000:], y[2000:]), estimator.finish()]
            for row in rows:
                assert np.isfinite(row.z).all()
                assert np.isfinite(row.unknown_input).all()
                assert not np.isnan(row.standard_deviation).any()
