# SPDX-License-Identifier: Apache-2.0
"""Whoever ships gains ships an estimator that starts at once and forgets an upset at once."""

from functools import cache
import math

from commands import ROOT
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS, PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.plant import Plant
from fhaosmo_ros.tools.tuning.tuner import stamps_of
import numpy as np
from observer_cases import remembered
import pytest

CONFIG = ROOT / 'config'
FILES = [
    path for path in sorted(CONFIG.glob('**/*.yaml'))
    if {'noise_size', 'correction_period'} <= load(path, 'estimator', ONLINE_PARAMETERS).keys()
]  # fmt: skip
RATE = 1000
HIT, BACK, SOON = 6 * RATE, 13 * RATE // 2, RATE
"""Samples: when it happens, when it is over, and when the error is usual again after that."""


class Case:
    """A parameter file, and samples of its own plant with the noise that it is for."""

    def __init__(self, path):
        self.path, self.parameters = path, load(path, 'estimator', ONLINE_PARAMETERS)
        plant = {k: v for k, v in load(path, 'plant').items() if k in PLANT_PARAMETERS}
        if not plant.get('quantisation'):
            plant['noise_std'] = self.parameters['noise_size']
        self.t = np.arange(12 * RATE) / RATE
        truth = Plant(plant).simulate(self.t)
        self.y, self.d, self.z = truth.y, truth.unknown_input, truth.z
        self.largest = np.abs(self.d).max()
        self.usual = self.errors(self.y, self.d)[len(self.t) // 4 :].max()
        self.settled = max(1.5 * self.usual, 0.1 * self.largest)

    def observed(self, y):
        """Return what an observer estimates, and that observer."""
        observer = Observer.from_yaml(self.path)
        return observer.run(self.t, y, 0.0), observer

    def errors(self, y, d, part=1, **changes):
        """Return |error of d| of the node's estimator."""
        estimator = OnlineEstimator(self.parameters | changes)
        found = estimator.run(stamps_of(self.t[: len(y) : part]), y[::part], 0.0)
        return np.abs(found.unknown_input - d[::part])

    def shifted(self, begin, end, offset):
        """Return y with an offset between two samples."""
        y = self.y.copy()
        y[begin:end] += offset
        return y


case_of = cache(Case)


@pytest.fixture(scope='module', params=FILES, ids=[path.stem for path in FILES])
def case(request):
    return case_of(request.param)


@pytest.fixture(scope='module')
def pendulum():
    return case_of(CONFIG / 'models' / 'pendulum.yaml')


@pytest.mark.parametrize('offset', [0.0, 0.1, 1.0, -10.0, 1000.0])
def test_start_and_sensor_that_is_wrong_for_half_a_second(case, offset):
    wrong = case.errors(case.shifted(HIT, BACK, offset), case.d)
    assert wrong[:HIT].max() < 1.5 * case.largest
    assert wrong[SOON : HIT if offset else None].max() < case.settled
    assert wrong.max() < 2.0 * case.largest
    assert wrong[BACK + SOON :].max() < case.settled


@pytest.mark.parametrize(('name', 'factor'), [
    ('state_sizes', 0.1), ('state_sizes', 10.0), ('unknown_input_size', 1 / 3),
    ('unknown_input_size', 3.0), ('noise_size', 1 / 3), ('noise_size', 3.0),
])  # fmt: skip
def test_start_with_sizes_that_are_wrong(case, name, factor):
    right = case.parameters[name]
    size = [factor * x for x in right] if isinstance(right, list) else factor * right
    assert case.errors(case.y, case.d, **{name: size}).max() < 1.5 * case.largest


@pytest.mark.parametrize('earlier', [1, 3, 5])
def test_plant_that_goes_back_in_its_motion(case, earlier):
    """As a simulator that is reset, or a bag that begins again; all states jump."""
    order = np.concatenate([np.arange(HIT), np.arange(HIT - earlier * RATE, len(case.t))])
    order = order[: len(case.t)]
    wrong = case.errors(case.y[order], case.d[order])
    assert wrong[HIT:].max() < 2.0 * case.largest
    assert wrong[HIT + SOON :].max() < case.settled


def test_offset_that_the_model_contradicts_is_taken_off_and_forgotten(pendulum):
    """A snapshot goes on from it."""
    stamps, middle = stamps_of(pendulum.t), HIT + 4 * RATE
    y = pendulum.shifted(HIT, middle + RATE, 1.0)
    one, other = (OnlineEstimator(pendulum.parameters) for _ in range(2))
    found = one.run(stamps[:middle], y[:middle])
    assert one.offset == pytest.approx(1.0, abs=0.01)
    settled = slice(HIT + RATE, middle)
    np.testing.assert_allclose(found.z[settled, 0], pendulum.z[settled, 0], atol=0.01)
    other.load_state_dict(one.state_dict())
    rest, again = (estimator.run(stamps[middle:], y[middle:]) for estimator in (one, other))
    np.testing.assert_array_equal(again.unknown_input, rest.unknown_input)
    assert (one.offset, one.counters.jumps, one.counters.divergences) == (0.0, 2, 0)


def test_sensor_that_is_put_right_is_believed(pendulum):
    """As a zero that is found after the start: the wrong one had needed a large d."""
    found, observer = pendulum.observed(pendulum.shifted(None, HIT, 1.0))
    assert observer.structure.memory['offset'] == 0.0
    assert np.abs(found.unknown_input - pendulum.d)[HIT + SOON :].max() < pendulum.settled


def test_jump_of_y_leaves_all_but_z1_of_a_plant_without_z1_in_its_model(case):
    y = case.shifted(HIT, None, 1000.0 * case.parameters['noise_size'])
    found, observer = case.observed(y)
    jumped = np.flatnonzero(found.status & Status.JUMPED)
    assert jumped.tolist() == [HIT + 20]  # more unlikely samples in a row: y is lost (D 21)
    if observer.structure.memory['offset'] == 0.0:
        np.testing.assert_allclose(found.z[HIT + RATE :, 0], y[HIT + RATE :], atol=0.1)
    wrong = np.abs(found.unknown_input - case.d)[HIT:]
    assert wrong.max() < max(1.5 * case.usual, 0.6 * case.largest)


def test_after_a_jump_of_y_the_next_sample_gives_the_time_of_the_estimate():
    """Only z1 follows the jump at once: that is wrong under the stamp of the sample before."""
    estimator = OnlineEstimator.from_yaml(CONFIG / 'noise_1e-3.yaml')
    stamps = 1_000_000 * np.arange(1, 1000)
    estimator.run(stamps[:500], np.zeros(500))
    told = [estimator.update(stamp, 1.0).status for stamp in stamps[500:521].tolist()]
    assert told[-1] & Status.JUMPED
    assert not any(status & Status.JUMPED for status in told[:-1])
    estimator.update(int(stamps[521]), math.nan)
    assert (estimator.estimate, estimator.stamp) == (None, None)
    estimator.update(int(stamps[522]), 1.0)
    assert estimator.stamp == stamps[522]
    np.testing.assert_allclose(estimator.estimate.z[0], 1.0, atol=0.01)


def test_jump_of_a_few_counts_of_an_encoder():
    """Some of its samples lie within 6 standard deviations, some beyond."""
    case, end = case_of(CONFIG / 'models' / 'dc_motor.yaml'), HIT + 5 * RATE
    wrong = case.errors(case.shifted(HIT, end, 10.0 * case.parameters['noise_size']), case.d)
    assert wrong[HIT:].max() < 0.1 * case.largest
    for moment in (HIT, end):
        assert wrong[moment + 3 * RATE // 10 : moment + RATE].max() < 1.5 * case.usual


def test_outliers_and_bursts_are_passed_over(case):
    rng, y = np.random.default_rng(8), case.y.copy()
    for k in np.flatnonzero(rng.random(len(y)) < 2e-3):
        y[k : k + 5] += 1000.0 * case.parameters['noise_size'] * rng.choice([-1.0, 1.0])
    wrong, clean = (rms(case.errors(x, case.d)[3 * RATE :]) for x in (y, case.y))
    assert wrong < 1.3 * clean


@pytest.mark.parametrize('part', [10, 2])
def test_another_rate(case, part):
    """The error is that of fewer samples, not that of wrong gains."""
    slow, wrong = (rms(case.errors(case.y, case.d, part=k)[3 * RATE // k :]) for k in (part, 1))
    assert slow < 4.0 * wrong
    if case.path.stem == 'noise_1e-4':  # correction_period follows it, where nothing is known
        wrong = case.errors(case.y, case.d, part=part, noise_size=0.0)
        assert wrong[8 * RATE // part :].max() < 3.0 * case.largest


def test_cascade_goes_on_from_its_start_as_a_kalman_filter():
    """Its levels are put where they would be had they followed it; else they search for long."""
    t = np.arange(3 * RATE) / RATE
    truth = Plant(disturbance_omega=1.0).simulate(t)
    found = Observer.from_yaml(CONFIG / 'demo.yaml').run(t, truth.y)
    assert np.abs(found.unknown_input - truth.unknown_input).max() < 0.05


def test_covariance_is_that_of_a_kalman_filter():
    """Step by step, with intervals of any length, against plain matrices."""
    observer = Observer.from_yaml(CONFIG / 'models' / 'pendulum.yaml')
    rng, values = np.random.default_rng(2), observer.parameters
    observer.start(0.5)
    schedule, noise = observer.configuration.schedule, values['noise_size'] ** 2
    p, age = remembered(observer, 'covariance').copy(), 0.0
    size, rate = values['unknown_input_size'], values['unknown_input_decay']
    intensity = size**2 * (2.0 * rate) ** 7 * 36.0 / 720.0
    speed = (intensity / (noise * values['correction_period'])) ** (0.5 / observer.levels)
    for _ in range(40):
        h = float(rng.uniform(0.5e-3, 3e-3))
        phi, q = schedule.linear.transition(h)
        p = phi @ p @ phi.T + q
        doubt = 3.0 ** math.exp(-0.5 * age * speed)
        gain = p[:, 0] / (p[0, 0] + doubt**2 * noise)
        p, age = p - np.outer(gain, p[0]), age + h
        observer.step(0.5, h)
        assert_alike(remembered(observer, 'covariance'), p, 1e-6)


def assert_alike(found, covariance, tolerance):
    """Compare covariances in units of their standard deviations."""
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(found / scale, covariance / scale, atol=tolerance)


def test_steady_covariance_solves_its_equation():
    configuration = Observer.from_yaml(CONFIG / 'noise_1e-4.yaml').configuration
    schedule, steady = configuration.schedule, configuration.steady
    phi, q = schedule.linear.transition(1e-3)
    gain = steady[:, 0] / (steady[0, 0] + schedule.variance)
    assert_alike(phi @ (steady - np.outer(gain, steady[0])) @ phi.T + q, steady, 1e-8)


def test_likely_sample_counts_as_two_usual_deviations_at_most():
    """It is used as if it were that large; nearer ones count as they are."""
    found = []
    for size in (1.0, 3.0, 5.0):
        observer = Observer.from_yaml(CONFIG / 'noise_1e-3.yaml')
        observer.run(np.arange(3 * RATE) / RATE, np.zeros(3 * RATE))
        found.append(observer.step(size * observer.parameters['noise_size'], 1.0 / RATE).z)
    np.testing.assert_allclose(found[2], found[1], rtol=1e-12)
    assert found[1][0] > 1.5 * found[0][0]
