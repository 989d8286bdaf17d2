# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: each disturbance against its formula, noise, the known input, bad input."""

from fhaosmo_ros.core import ConfigurationError, Plant
from fhaosmo_ros.core.simulation.disturbance import KINDS
from fhaosmo_ros.core.simulation.plant import quantised
import numpy as np
import pytest

T = np.linspace(0.0, 24.0, 2401)
WAVE = {
    'disturbance_amplitude': 0.7,
    'disturbance_omega': 2.0,
    'disturbance_offset': -0.2,
    'disturbance_start': 4.005,
}


def chirp(t):
    """Return the sine of the integral of an angular frequency that rises, then stays."""
    rate = (20.0 - 2.0) / 20.0
    rising = 2.0 * t + rate * t**2 / 2.0
    at_end = 2.0 * 20.0 + rate * 20.0**2 / 2.0
    return np.sin(np.where(t < 20.0, rising, at_end + 20.0 * (t - 20.0)))


FORMULAS = {
    'none': lambda t: 0.0 * t,
    'sine': lambda t: 0.7 * np.sin(2.0 * t) - 0.2,
    'step': lambda t: np.where(t >= 4.005, 0.7, 0.0) - 0.2,
    'square': lambda t: 0.7 * np.where(np.sin(2.0 * t) >= 0.0, 1.0, -1.0) - 0.2,
    'chirp': lambda t: 0.7 * chirp(t) - 0.2,
}


def test_every_kind_is_tried():
    assert set(FORMULAS) == set(KINDS)


@pytest.mark.parametrize('kind', KINDS)
def test_disturbance_follows_its_formula(kind):
    plant = Plant(WAVE | {'disturbance': kind})
    np.testing.assert_allclose(plant.simulate(T).unknown_input, FORMULAS[kind](T), atol=1e-12)


@pytest.mark.parametrize('kind', KINDS)
def test_disturbance_drives_the_last_state(kind):
    p = {'order': 1, 'phi': ['0'], 'initial_state': 1.5, 'integration_step': 1e-3}
    t = np.linspace(0.0, 24.0, 24001)
    z = Plant(WAVE | p | {'disturbance': kind}).simulate(t).z[:, 0]
    d = FORMULAS[kind](t)
    integral = 1.5 + np.concatenate([[0.0], np.cumsum(0.5e-3 * (d[1:] + d[:-1]))])
    # Each jump of d falls within one step: less than step * amplitude.
    np.testing.assert_allclose(z, integral, atol=1e-5 if kind in ('sine', 'chirp') else 5e-3)


def test_chirp_is_continuous_where_its_sweep_ends():
    t = 20.0 + np.linspace(-1e-6, 1e-6, 201)
    d = Plant(WAVE | {'disturbance': 'chirp'}).simulate(t).unknown_input
    # Both sides have the angular frequency 20; the slope of d is at most 0.7 * 20.
    assert np.max(np.abs(np.diff(d))) <= 1.01 * 0.7 * 20.0 * 1e-8
    np.testing.assert_allclose(np.diff(d), np.diff(d)[0], rtol=1e-3)


def test_noise_is_seeded_and_of_the_right_size():
    p = {'order': 1, 'phi': ['0'], 'disturbance': 'none', 'noise_std': 0.03}
    t = np.linspace(0.0, 1.0, 100001)
    one, same, other = (Plant(p | {'noise_seed': seed}).simulate(t) for seed in (5, 5, 6))
    noise = one.y - one.z[:, 0]
    np.testing.assert_array_equal(same.y, one.y)
    assert np.all(other.y != one.y)
    # Standard errors of the mean and of the deviation of 1e5 samples: 1e-4 and 7e-5.
    np.testing.assert_allclose(np.mean(noise), 0.0, atol=4e-4)
    np.testing.assert_allclose(np.std(noise), 0.03, atol=3e-4)
    np.testing.assert_allclose(np.mean(noise[1:] * noise[:-1]), 0.0, atol=1.2e-5)  # white
    np.testing.assert_array_equal(one.z[:, 0], 0.2)  # the truth has none


@pytest.mark.filterwarnings('error')
def test_quantisation_far_below_the_output_changes_nothing():
    y = np.array([1e300, -1e300, 0.3, np.inf, np.nan])
    np.testing.assert_array_equal(quantised(y, 5e-324), y)
    np.testing.assert_allclose(quantised(y, 1e-12)[:3], y[:3], rtol=1e-11)


def test_quantised_output_lies_on_the_grid_next_to_the_noisy_one():
    p = WAVE | {'noise_std': 0.1, 'disturbance': 'chirp'}
    fine, coarse = (Plant(p | {'quantisation': q}).simulate(T) for q in (0.0, 0.25))
    np.testing.assert_array_equal(coarse.y % 0.25, 0.0)
    assert 0.1 < np.max(np.abs(coarse.y - fine.y)) <= 0.125
    np.testing.assert_array_equal(coarse.z, fine.z)


def test_samples_equal_a_simulation():
    p = WAVE | {'noise_std': 0.1, 'disturbance': 'chirp', 'quantisation': 0.03}
    t = np.cumsum(np.random.default_rng(1).uniform(1e-5, 5e-3, 300))
    whole = Plant(p).simulate(t)
    plant = Plant(p)
    for k, one in enumerate(plant.sample(at) for at in t):
        assert one.y == whole.y[k]
        assert one.unknown_input == whole.unknown_input[k]
        np.testing.assert_array_equal(one.z, whole.z[k])


def test_sample_is_a_copy():
    plant = Plant()
    first = plant.sample(0.1)
    kept = first.z.copy()
    plant.sample(5.0)
    np.testing.assert_array_equal(first.z, kept)


def test_known_input_acts_during_the_interval_that_ends_at_its_time():
    plant = Plant({'order': 1, 'phi': ['u'], 'initial_state': 0.0, 'disturbance': 'none'})
    assert plant.uses_input
    truth = plant.simulate([0.0, 0.5, 1.0], [99.0, 2.0, -6.0])
    np.testing.assert_allclose(truth.z[:, 0], [0.0, 1.0, -2.0], atol=1e-12)


def test_live_change_acts_from_now_on():
    plant = Plant({'order': 1, 'phi': ['0'], 'initial_state': 0.0, 'disturbance': 'none'})
    plant.advance(1.0)
    plant.configure({'disturbance': 'step', 'disturbance_amplitude': 2, 'disturbance_start': 0})
    truth = plant.sample(2.0)
    # A change may act from the last point of the grid on, one integration step earlier.
    np.testing.assert_allclose(truth.z, [2.0], atol=2.0 * plant.parameters['integration_step'])
    assert truth.unknown_input == 2.0


def test_setting_the_seed_starts_the_noise_again():
    plant = Plant({'order': 1, 'phi': ['0'], 'disturbance': 'none', 'noise_std': 1.0})
    first = [plant.sample(t).y for t in (0.1, 0.2, 0.3)]
    plant.configure({'noise_seed': 1})
    np.testing.assert_array_equal([plant.sample(t).y for t in (0.4, 0.5, 0.6)], first)
    plant.configure({'noise_std': 0.0})
    assert plant.sample(0.7).y == 0.2


@pytest.mark.parametrize(
    ('parameters', 'named', 'allowed', 'arrived'),
    [
        ({'disturbance': 'sinus'}, 'disturbance', 'none, sine, step', "did you mean 'sine'"),
        ({'disturbance_omega': -1.0}, 'disturbance_omega', '>= 0', '-1.0'),
        ({'disturbance_amplitude': float('nan')}, 'disturbance_amplitude', 'a number', 'nan'),
        ({'noise_std': -0.1}, 'noise_std', '>= 0', '-0.1'),
        ({'noise_seed': 1.5}, 'noise_seed', 'an integer', '1.5'),
        ({'quantisation': -1.0}, 'quantisation', '>= 0', '-1.0'),
        ({'integration_step': 0.0}, 'integration_step', '>= 1e-06', '0.0'),
        ({'initial_state': [1.0, 2.0]}, 'initial_state', '1 or 3 values', '[1.0, 2.0]'),
        ({'phi': ['0', '0']}, 'phi', '3 expressions', "['0', '0']"),
        ({'order': 0}, 'order', '>= 1', '0'),
        ({'noise': 0.1}, 'noise', 'did you mean', 'noise_std'),
    ],
)
def test_bad_value_is_refused_in_one_line(parameters, named, allowed, arrived):
    with pytest.raises(ConfigurationError) as error:
        Plant(parameters)
    message = str(error.value)
    assert message.isprintable()
    for part in (f"'{named}'", allowed, arrived):
        assert part in message


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'noise_std': -1.0}, '>= 0'),
        ({'initial_state': [9.0]}, "can't change in a running plant"),
        ({'integration_step': 0.01}, "can't change in a running plant"),
        ({'order': 2}, "can't change in a running plant"),
        ({'nois_std': 1.0}, "did you mean 'noise_std'"),
    ],
)
def test_refused_change_changes_nothing(changes, reason):
    plant = Plant()
    before = plant.parameters
    with pytest.raises(ConfigurationError, match=reason):
        plant.configure({'disturbance_amplitude': 9.0} | changes)
    assert plant.parameters == before
    assert plant.sample(np.pi / 2.0).unknown_input == Plant().sample(np.pi / 2.0).unknown_input


@pytest.mark.parametrize('t', [np.nan, np.inf, -np.inf])
def test_time_that_is_not_finite_is_refused(t):
    plant = Plant()
    for call in (plant.advance, plant.sample, lambda t: plant.simulate([0.0, t])):
        with pytest.raises(ConfigurationError, match=r'expected (a )?finite time'):
            call(t)
