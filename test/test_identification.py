# SPDX-License-Identifier: Apache-2.0
"""What `tune` finds in a y without the truth (D 30), and when it refuses."""

import bag_files as files
from fhaosmo_ros.core import ConfigurationError, Family, Observer, OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.tuning import identify
from fhaosmo_ros.tools.tuning.command import main, notes
from fhaosmo_ros.tools.tuning.identify import Design
from fhaosmo_ros.tools.tuning.tuner import stamps_of
import numpy as np
from observer_cases import matern, states_of
import pytest
from scipy.signal import lfilter

H, K = 5e-3, 4000
PHI = ['0', '-2*z2']
NOISE, SIZE, RATE = 1e-3, 1.0, 2.0
"""Of the noise on y, and of a Matern d with one derivative (D 17)."""
T = np.arange(K) * H


def plant():
    """Return the states z1, z2 and d."""
    d = SIZE * matern(K, RATE, 1, np.random.default_rng(1), H)
    return np.column_stack([states_of(np.array([[0.0, 1.0], [0.0, -2.0]]), d, period=H), d])


def noise():
    return NOISE * np.random.default_rng(2).standard_normal(K)


def found_in(y, phi=PHI, **given):
    given = {'order': len(phi), 'phi': list(phi)} | given
    values = ESTIMATOR_PARAMETERS.complete(given)
    found = identify.Identification((T, y, np.zeros((K, 1))), values, given)
    return found, *found.gains()


@pytest.fixture(scope='module', name='plain')
def _plain():
    return found_in(plant()[:, 0] + noise())


def test_truth_is_likelier_than_other_designs(plain):
    found, *_ = plain
    bandwidth = ((SIZE**2 * (2.0 * RATE) ** 3 / 2.0) / (NOISE**2 * H)) ** (1 / 8)
    truth = Design(1, bandwidth, RATE)
    assert found.size_of_input(truth, NOISE) == pytest.approx(SIZE)
    best = found.evaluate(truth).log_likelihood
    for change in ({'bandwidth': 1.5 * bandwidth}, {'decay': 10.0 * RATE}):
        assert found.evaluate(truth._replace(**change)).log_likelihood < best - 3.0
    assert found.best.log_likelihood > best - 1.0


def test_noise_and_size_of_d_are_found(plain):
    found, gains, expected = plain
    assert found.best.noise == pytest.approx(NOISE, rel=0.03)
    assert 0.5 * SIZE < gains['unknown_input_size'] < 2.0 * SIZE
    assert 0.3 * RATE < found.best.design.decay < 3.0 * RATE
    assert found.whiteness()[1] > 1e-3
    along = OnlineEstimator(gains).run(stamps_of(T), found.samples.y)
    error = rms((along.unknown_input - plant()[:, 2])[K // 10 :])
    assert error == pytest.approx(expected[-1], rel=0.25)


def test_gains_are_those_of_the_likeliest_filter(plain):
    """The observer of the YAML follows the filter whose likelihood was maximised."""
    found, gains, expected = plain
    estimate = Observer(gains).run(T, found.samples.y)
    late, filtered = slice(K // 4, None), found.best.estimates
    for i, column in enumerate([*estimate.z.T, estimate.unknown_input]):
        apart = np.sqrt(np.mean((column - filtered[:, i])[late] ** 2))
        assert apart < 0.25 * expected[i], i


def test_outliers_are_left_out_and_told(plain):
    y = plant()[:, 0] + noise()
    y[7::150] += 50.0 * NOISE * (-1.0) ** np.arange(len(y[7::150]))
    found, gains, expected = found_in(y)
    assert found.outliers == len(y[7::150])
    assert any('outliers' in text for text in notes(found, *found.whiteness()))
    assert list(notes(plain[0], *plain[0].whiteness())) == []
    assert found.best.noise == pytest.approx(plain[0].best.noise, rel=0.02)
    assert expected[-1] == pytest.approx(plain[2][-1], rel=0.15)
    along = OnlineEstimator(gains)
    along.run(stamps_of(T), y)
    assert along.counters.divergences == 0


def test_given_values_stay_but_not_former_gains():
    former = {'unknown_input_size': 9.9, 'correction_period': 1.0, 'fuzzy_widths': [5.0]}
    given = {'noise_size': 2e-3, 'unknown_input_derivatives': 0, 'unknown_input_decay': 1.5}
    found, gains, _ = found_in(plant()[:, 0] + noise(), **given, **former)
    assert given.items() <= gains.items()
    assert not any(gains[name] == value for name, value in former.items())
    assert (found.best.noise, found.best.design.decay) == pytest.approx((2e-3, 1.5))


def too_few_states():
    """Return the y of a d that moves like a random walk and acts on z2'."""
    shocks = 20.0 * np.sqrt(6.0 * H) * np.random.default_rng(6).standard_normal(K)
    d = lfilter([1.0], [1.0, -np.exp(-3.0 * H)], shocks)
    return np.cumsum(lfilter([H], [1.0, -np.exp(-2.0 * H)], d)) * H + noise()


@pytest.mark.parametrize(('y', 'phi', 'about'), [
    (lambda: np.full(K, 1.25), PHI, 'constant'),
    (lambda: plant()[:, 0], PHI, 'expected noise, got none'),
    (lambda: 3.0 + noise(), PHI, 'explains with d = 0'),
    (lambda: np.cumsum(noise()), PHI, 'drift'),
    (lambda: np.where(T < 1.0, noise(), np.nan), PHI, 'at least 500 samples'),
    (lambda: plant()[:, 0] + lfilter([1.0], [1.0, -0.9], noise()), PHI, 'noise correlated'),
    (too_few_states, ['0', '-2*z2', '0'], 'order'),
    (lambda: 3.0 + plant()[:, 0] + noise(), ['0', '-2*z2 - sqrt(z1)'], 'slopes at z = 0'),
])  # fmt: skip
@pytest.mark.filterwarnings('error')
def test_where_there_are_no_gains_it_says_why(y, phi, about):
    with pytest.raises(ConfigurationError, match=about):
        found_in(y(), phi=phi)


@pytest.mark.parametrize(('y', 'phi', 'about'), [
    (lambda: plant()[:, 0] + noise(), ['0', '4*z1 - 2*z2'], 'unstable'),
    (lambda: plant()[:, 0] + lfilter([1.0], [1.0, -0.5], noise()), PHI, 'not white'),
])  # fmt: skip
def test_model_that_does_not_fit_is_told(y, phi, about):
    found, *_ = found_in(y(), phi=phi)
    assert about in ' '.join(notes(found, *found.whiteness()))


@pytest.mark.parametrize('quantum', [0.0, 1e-3])
def test_quantum_is_found(quantum):
    r = Family({'noise_std': 1e-3, 'quantisation': quantum, 'integration_step': 1e-3}).recording(0)
    assert identify.quantum(r.y) == pytest.approx(quantum, rel=1e-3)


def test_bad_samples_are_left_out():
    t, y = np.array([0.0, 1.0, 1e6, 1.0, 2.0]), np.array([0.0, 1.0, np.nan, 2.0, 3.0])
    t, y, _ = identify.usable(t, y, np.zeros((5, 1)))
    np.testing.assert_array_equal([t, y], [[0.0, 1.0, 2.0], [0.0, 1.0, 3.0]])


def test_command_says_what_a_bag_shows_or_that_it_can_give_no_gains(tmp_path, capsys):
    family = {'duration': 9.0, 'integration_step': 1e-3, 'sample_rate': 200.0}
    r = Family(family | {'noise_std': 1e-3, 'dropout': 0.02}).recording(0)
    stamps = 10**18 + np.round(r.t * 1e9).astype(np.int64)
    bag, out = files.write(tmp_path / 'bag', files.floats(stamps, r.y)), tmp_path / 'out'
    path = tmp_path / 'p.yaml'
    path.write_text(
        '/**: {ros__parameters: {channels: [hip, elbow], input_topic: /y, hip.gains: self_tuning, '
        "hip.noise_size: 9.0, hip.lambda: [1.0], elbow.phi: ['0', '0', '0']}}"
    )
    command = [f'--bag={bag}', f'-o{out}', f'--params-file={path}', '--channel=hip']
    assert main([*command, '-p', 'noise_size:=1000.0']) == 2
    assert 'd = 0' in capsys.readouterr().err
    assert not out.exists()
    assert main([*command, '-p', 'noise_size:=0.0']) == 0  # which wins
    values = load(out / 'gains.yaml', 'estimator')
    assert not OnlineEstimator(ESTIMATOR_PARAMETERS.complete(values)).observer.self_tuning
    assert values['noise_size'] == pytest.approx(1e-3, rel=0.1)
    assert values['correction_period'] == pytest.approx(1.0 / 200.0, rel=1e-3)
    assert (values['channels'], len(values['lambda']) > 1) == (['hip'], True)
    for text in ((out / 'report.md').read_text(), capsys.readouterr().out):
        assert '| expected error of d' in text
