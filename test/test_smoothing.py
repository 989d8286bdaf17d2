# SPDX-License-Identifier: Apache-2.0
"""Estimates from the samples before and after: theorems of smoothing, faults of data, lags."""

import copy
import pickle

from fhaosmo_ros.core import Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.observer import smoother
from fhaosmo_ros.core.observer.kalman import INPUT_DOUBT, STATES_DOUBT
from fhaosmo_ros.core.observer.smoothing import BEGINS, MEASURED, Rows
from fhaosmo_ros.core.observer.status import REJECTED, Status
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
import pytest
from scipy.linalg import expm

CONFIG = 'config/noise_1e-3.yaml'
MS = 1_000_000
NOISE = 1e-3


def recording(seconds=8.0, noise=NOISE, seed=3, **changes):
    """Return t, y and the truth of the paper's plant."""
    t = np.arange(0.0, seconds, 1e-3)
    truth = Plant({'disturbance_omega': 2.0, **changes}).simulate(t)
    y = truth.y + noise * np.random.default_rng(seed).standard_normal(len(t))
    return t, y, truth


def online(**changes):
    """Return an estimator with the gains for this noise."""
    own = OnlineEstimator.from_yaml(CONFIG).parameters
    return OnlineEstimator(own | changes)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def textbook(observer, t, y):
    """
    Return filter and smoother of Rauch, Tung and Striebel with exact matrices, and P of both.

    Written from the book: nothing of the package but its parameters.
    """
    p, n = observer.parameters, observer.order
    levels = n + 1 + p['unknown_input_derivatives']
    a = np.eye(levels, k=1)
    a[:n, :n] += observer.model.jacobian(np.zeros(n))
    a[range(n, levels), range(n, levels)] = -p['unknown_input_decay']
    k, rate = p['unknown_input_derivatives'], p['unknown_input_decay']
    factorials = np.cumprod([1, *range(1, 2 * k + 1)])
    density = (2 * rate) ** (2 * k + 1) * factorials[k] ** 2 / factorials[2 * k]
    drive = np.zeros((levels, levels))
    drive[-1, -1] = p['unknown_input_size'] ** 2 * density
    cov = np.zeros((levels, levels))
    cov[range(n), range(n)] = np.square(STATES_DOUBT * np.broadcast_to(p['state_sizes'], n))
    cov[0, 0] = p['noise_size'] ** 2
    tail = a[n:, n:]
    eye = np.eye(k + 1)
    lyapunov = np.kron(tail, eye) + np.kron(eye, tail)
    stationary = np.linalg.solve(lyapunov, -drive[n:, n:].ravel()).reshape(k + 1, k + 1)
    cov[n:, n:] = INPUT_DOUBT**2 * stationary
    x = np.zeros(levels)
    x[0] = y[0]
    filtered, predicted, transitions = [(x, cov)], [], []
    for h, sample in zip(np.diff(t), y[1:], strict=True):
        zero = np.zeros_like(a)
        whole = expm(np.block([[-a, drive], [zero, a.T]]) * h)
        f = whole[levels:, levels:].T
        q = f @ whole[:levels, levels:]
        x, cov = f @ x, f @ cov @ f.T + q
        predicted.append((x, cov))
        transitions.append(f)
        if np.isfinite(sample):
            gain = cov[:, 0] / (cov[0, 0] + p['noise_size'] ** 2)
            x, cov = x + gain * (sample - x[0]), cov - np.outer(gain, cov[0])
        filtered.append((x, cov))
    x, cov = filtered[-1]
    smoothed = [x]
    scale = np.sqrt(np.diag(predicted[-1][1]))  # the inverse in units that are alike
    for (xf, pf), (xp, pp), f in zip(
        filtered[-2::-1], predicted[::-1], transitions[::-1], strict=True
    ):
        c = pf @ f.T / scale @ np.linalg.inv(pp / np.outer(scale, scale)) / scale
        x = xf + c @ (x - xp)
        smoothed.append(x)
    deviations = np.sqrt([np.diag(pf) for _, pf in filtered])
    return np.array([xf for xf, _ in filtered]), np.array(smoothed[::-1]), deviations


def bounded_noise(count, size, seed=1):
    """Return noise without values that Huber's weights would touch."""
    return size * np.random.default_rng(seed).uniform(-1.7, 1.7, count)


@pytest.mark.parametrize('steps', ['even', 'irregular', 'missing'])
def test_it_is_the_smoother_of_rauch_tung_and_striebel(steps):
    random = np.random.default_rng(5)
    h = np.full(2500, 1e-3)
    if steps == 'irregular':
        h = random.uniform(0.2e-3, 3e-3, 2500)
        h[1000] = 0.04
    t = np.cumsum(h)
    truth = Plant({'disturbance_omega': 2.0}).simulate(np.arange(0.0, t[-1] + 1e-3, 1e-4))
    y = np.interp(t, np.arange(len(truth.y)) * 1e-4, truth.y) + bounded_noise(len(t), NOISE)
    if steps == 'missing':
        y[600:640] = y[1200] = np.nan
    observer = Observer.from_yaml(CONFIG)
    found = observer.smooth(t, y)
    filtered, smoothed, deviation = textbook(observer, t, y)
    ours = np.column_stack([found.z, found.unknown_input])
    n = observer.order
    assert np.abs((ours - smoothed[:, : n + 1]) / deviation[:, : n + 1]).max() < 0.02
    # At the last sample nothing is known beside what the filter knows.
    last = np.abs((ours[-1] - filtered[-1, : n + 1]) / deviation[-1, : n + 1])
    assert last.max() < 0.02


def test_it_is_better_than_the_filter_and_the_longer_lag_than_the_shorter():
    t, y, truth = recording(12.0)
    stamps, judged = np.round(t * 1e9).astype(np.int64) + MS, slice(2000, 9000)
    d = truth.unknown_input[judged]
    whole = Observer.from_yaml(CONFIG).smooth(t, y).unknown_input[judged]
    errors = [rms(online().run(stamps, y).unknown_input[judged] - d)]
    differences = []
    for lag in (0.1, 0.3, 1.0, 2.5):
        lagging = online(smoothing_lag=lag).run(stamps, y)
        np.testing.assert_array_equal(lagging.t, stamps[: len(lagging.t)])
        assert len(lagging.t) == len(t) - round(lag * 1000)
        errors.append(rms(lagging.unknown_input[judged] - d))
        differences.append(np.abs(lagging.unknown_input[judged] - whole).max())
    errors.append(rms(whole - d))
    assert (np.diff(errors[:4]) < 0.0).all()
    assert errors[-1] < 0.4 * errors[0]
    # What still comes counts for less and less, exponentially.
    assert differences[3] < 0.05 * differences[2] < 0.05 * 0.3 * differences[1]


def test_blocks_change_nothing(monkeypatch):
    t, y, _ = recording(12.0)
    whole = Observer.from_yaml(CONFIG).smooth(t, y)
    monkeypatch.setattr(smoother, 'BLOCK', 1500)
    parts = Observer.from_yaml(CONFIG).smooth(t, y)
    estimator = online()
    estimator.smooth()
    stamps = np.round(t * 1e9).astype(np.int64) + MS
    rows = [estimator.run(stamps[k : k + 700], y[k : k + 700]) for k in range(0, len(t), 700)]
    most = max(len(row.t) for row in rows)
    rows.append(estimator.finish())
    assert 0 < most < 4000  # handed out meanwhile
    for found in (parts.unknown_input, np.concatenate([row.unknown_input for row in rows])):
        np.testing.assert_allclose(found, whole.unknown_input, rtol=0.0, atol=1e-7)


def test_one_by_one_is_the_same_as_a_run():
    t, y, _ = recording(2.0)
    y[700:710] = np.nan
    y[900] += 1.0
    stamps = np.round(t * 1e9).astype(np.int64) + 5
    stamps[1400:] += 2 * 10**9  # beyond max_gap
    many, one = online(smoothing_lag=0.1), online(smoothing_lag=0.1)
    rows = many.run(stamps, y)
    known = dict(zip(rows.t.tolist(), rows.unknown_input.tolist(), strict=True))
    published = set()
    for stamp, sample in zip(stamps.tolist(), y.tolist(), strict=True):
        estimate = one.update(stamp, sample)
        assert (estimate is None) == (one.stamp is None)
        if estimate is not None:
            assert known[one.stamp] == estimate.unknown_input
            assert one.stamp <= stamp - 100 * MS
            published.add(one.stamp)
    # Rows before a restart become final with it; live ones are too old then.
    assert len(rows.t) - 120 < len(published) < len(rows.t)
    assert one.stamp == stamps[-1] - 100 * MS


def test_tuning_is_that_of_the_sample_not_of_the_present():
    t, y, _ = recording(0.5)
    stamps = np.round(t * 1e9).astype(np.int64) + 5
    settings = {'gains': 'self_tuning'}
    present = OnlineEstimator(settings).run(stamps, y)
    past = OnlineEstimator(settings | {'smoothing_lag': 0.1})
    heard = {}
    for stamp, sample in zip(stamps.tolist(), y.tolist(), strict=True):
        if past.update(stamp, sample) is not None:
            heard[past.stamp] = [*past.tuning[:3], *past.tuning.derivatives]
    rows = OnlineEstimator(settings | {'smoothing_lag': 0.1}).run(stamps, y)
    used = np.flatnonzero((present.status & REJECTED) == 0)[: len(rows.t)]
    np.testing.assert_array_equal(rows.t, present.t[used])
    np.testing.assert_array_equal(rows.tuning, present.tuning[used])
    known = dict(zip(rows.t.tolist(), rows.tuning, strict=True))
    assert len(heard) > 200
    for stamp, tuning in heard.items():
        np.testing.assert_array_equal(tuning, known[stamp])


def test_nothing_is_smoothed_across_a_restart():
    t, y, _ = recording(4.0)
    stamps = np.round(t * 1e9).astype(np.int64) + 5
    late = stamps + 10 * 10**9
    together, alone = online(), online()
    together.smooth()
    alone.smooth()
    both = together.run(np.append(stamps, late), np.append(y, 5.0 + y))
    rest = together.finish()
    first = [alone.run(stamps, y), alone.finish()]
    ours = np.concatenate([both.unknown_input, rest.unknown_input])
    theirs = np.concatenate([row.unknown_input for row in first])
    np.testing.assert_allclose(ours[: len(theirs)], theirs, rtol=0.0, atol=1e-9)
    assert len(ours) == 2 * len(t) - 1  # the sample that announced the restart


def test_outliers_count_as_little_as_in_the_observer():
    t, y, truth = recording(10.0)
    judged = slice(2000, 9000)
    observer = Observer.from_yaml(CONFIG)
    clean = rms((observer.smooth(t, y).unknown_input - truth.unknown_input)[judged])
    bad = np.random.default_rng(2).choice(len(y), len(y) // 50, replace=False)
    y[bad] += np.random.default_rng(3).normal(0.0, 0.3, len(bad))
    found = observer.smooth(t, y)
    assert rms((found.unknown_input - truth.unknown_input)[judged]) < 1.3 * clean


@pytest.mark.parametrize('stays', [False, True])
def test_a_jump_of_y_alone_hardly_matters(stays):
    t, y, truth = recording(8.0)
    judged = slice(2000, 6000)
    observer = Observer.from_yaml(CONFIG)
    clean = rms((observer.smooth(t, y).unknown_input - truth.unknown_input)[judged])
    y[4000 : len(y) if stays else 4500] += 5.0
    found = observer.smooth(t, y)
    assert (found.status & Status.JUMPED).any()
    assert rms((found.unknown_input - truth.unknown_input)[judged]) < 3.0 * clean
    assert np.abs((found.z[:, 0] - y)[4100:4400]).max() < 3.0 * NOISE
    stamps = np.round(t * 1e9).astype(np.int64) + MS
    whole, parts = online(), online()
    whole.smooth()
    parts.smooth()
    d = np.append(whole.run(stamps, y).unknown_input, whole.finish().unknown_input)
    rows = [parts.run(stamps[k : k + 13], y[k : k + 13]) for k in range(0, len(t), 13)]
    rows.append(parts.finish())
    np.testing.assert_array_equal(np.concatenate([row.unknown_input for row in rows]), d)
    used = (found.status & REJECTED) == 0
    np.testing.assert_allclose(d, found.unknown_input[used], rtol=0.0, atol=0.1 * clean)


def test_known_inputs_and_a_nonlinear_model():
    phi = ['0', '-19.62*sin(z1) - 0.3*z2 - 0.5*tanh(z2/0.1) + u']
    t = np.arange(0.0, 8.0, 1e-3)
    u = 5.0 * np.sin(7.0 * t) * (np.sin(1.3 * t) > 0)
    model = {'order': 2, 'phi': phi, 'initial_state': [0.5, 0.0], 'disturbance_amplitude': 4.0}
    truth = Plant(model).simulate(t, u)
    y = truth.y + 5e-4 * np.random.default_rng(4).standard_normal(len(t))
    own = Observer.from_yaml('config/models/pendulum.yaml').parameters
    observer = Observer(own | {'phi': phi})
    judged = slice(1500, 7000)
    errors = [
        rms((found.unknown_input - truth.unknown_input)[judged])
        for found in (observer.run(t, y, u), observer.smooth(t, y, u))
    ]
    assert errors[1] < 0.35 * errors[0]


@pytest.mark.parametrize('file', ['demo', 'noise_1e-4'])
def test_any_observer_can_run_forward(file):
    t, y, truth = recording(6.0, noise=1e-5)
    judged = slice(2000, 5000)
    observer = Observer.from_yaml(f'config/{file}.yaml')
    run, smoothed = observer.run(t, y), observer.smooth(t, y)
    before, after = (
        rms((found.unknown_input - truth.unknown_input)[judged]) for found in (run, smoothed)
    )
    assert after < before


def test_what_is_missing_is_told_in_one_line():
    t, y, _ = recording(0.1)
    with pytest.raises(ConfigurationError, match=r"expected 'noise_size' > 0.*got 0 and true"):
        Observer().smooth(t, y)
    with pytest.raises(ConfigurationError, match="'noise_size'"):
        OnlineEstimator({'smoothing_lag': 0.1})
    with pytest.raises(ConfigurationError, match='past or of the present'):
        online(smoothing_lag=0.1, predict_to_now=True)
    estimator = online(smoothing_lag=0.1)
    with pytest.raises(ConfigurationError, match="'noise_size'"):
        estimator.configure({'noise_size': 0.0})


def test_nothing_usable_gives_nothing():
    observer = Observer.from_yaml(CONFIG)
    assert len(observer.smooth([], []).t) == 0
    found = observer.smooth([0.0, 1e-3], [np.nan, np.nan])
    np.testing.assert_array_equal(found.unknown_input, observer.estimate.unknown_input)


@pytest.mark.parametrize('seed', range(4))
def test_any_data_gives_finite_estimates(seed):
    random = np.random.default_rng(seed)
    count = 3000
    y = random.standard_normal(count).cumsum()
    y[random.random(count) < 0.05] = np.nan
    y[random.random(count) < 0.02] = 1e8
    stamps = random.integers(-MS, 4 * MS, count).cumsum() + 10**12
    stamps[random.random(count) < 0.01] += 3 * 10**9
    t, y = stamps * 1e-9, y
    for phi in (['0', '0', '-z3'], ['0', 'sin(z1)', '-z3*abs(z3)']):
        p = OnlineEstimator.from_yaml(CONFIG).parameters | {'phi': phi}
        increasing = np.sort(t) + np.arange(count) * 1e-9
        assert np.isfinite(Observer(dict(p)).smooth(increasing, y).unknown_input).all()
        for lag in (0.0, 0.05):
            estimator = OnlineEstimator(p | {'smoothing_lag': lag})
            if not lag:
                estimator.smooth()
            rows = estimator.run(stamps, y)
            assert np.isfinite(rows.z).all()
            assert np.isfinite(estimator.finish().unknown_input).all()


@pytest.mark.parametrize('lag', [None, 5 * MS])
@pytest.mark.parametrize('bad', ['y', 'u', 'h', 'own'])
def test_what_is_not_finite_leaves_the_observers_own_estimates(bad, lag):
    """Where numbers overflow the observer's estimate stands; elsewhere it is smoothed."""
    observer = Observer(Observer.from_yaml(CONFIG).parameters | {'phi': ['0', '0', 'u - z3']})
    count, found = 400, []
    for damage in (0.0, {'y': np.nan, 'u': 1e308, 'h': 1e300, 'own': 1e200}[bad]):
        rows = {
            'own': np.zeros((count, 1, observer.levels)),  # an observer that estimates 0
            'y': NOISE * np.random.default_rng(1).standard_normal(count),
            'h': np.full(count, 1e-3), 'u': np.zeros((count, 1)), 'times': MS * np.arange(count),
            'kinds': np.full(count, MEASURED), 'models': np.empty((count, 0)),
        }  # fmt: skip
        rows['kinds'][0] = BEGINS
        if damage:
            rows[bad][200 : 205 if bad == 'u' else 201] = damage
        smoothing = Rows(observer.configuration)
        smoothing.append(**rows)
        parts = [smoothing.smooth(count, lag), smoothing.smooth(count)]
        found.append(np.concatenate(parts)[:, 0])
    assert np.isfinite(found[1]).all()
    assert len(found[1]) == count
    others = np.arange(count) != 200
    assert np.abs(found[1][others] - found[0][others])[:, 0].max() < 3.0 * NOISE
    # Where nothing passes, y is smoothed on both sides: the estimates are not just the observer's.
    assert np.abs(found[1][210:, 0]).min() > 0.0


def test_parameters_of_another_model_are_refused():
    rows = Rows(Observer.from_yaml(CONFIG).configuration)
    with pytest.raises(ValueError, match='another model'):
        rows.configure(Observer.from_yaml('config/models/pendulum.yaml').configuration)


COPIES = (copy.copy, copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e)))  # noqa: S301


@pytest.mark.parametrize('way', COPIES)
@pytest.mark.parametrize('gains', ['fixed', 'self_tuning'])
def test_a_copy_goes_on_alike(way, gains):
    t, y, _ = recording(1.5)
    stamps = np.round(t * 1e9).astype(np.int64) + MS
    one = online(smoothing_lag=0.05)
    if gains == 'self_tuning':
        one = OnlineEstimator({'gains': 'self_tuning', 'smoothing_lag': 0.05})
    one.run(stamps[:900], y[:900])
    found = [e.run(stamps[900:], y[900:]) for e in (way(one), one)]
    for name in ('t', 'unknown_input', 'standard_deviation'):
        np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name))
    assert len(found[0].t) == len(t) - 900
