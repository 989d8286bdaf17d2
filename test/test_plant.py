# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: disturbances by their formulas, noise, inputs; families of recordings."""

from fhaosmo_ros.core import ConfigurationError, Family, Plant
from fhaosmo_ros.core.simulation.plant import quantised, respond
from fhaosmo_ros.core.simulation.system import KINDS
import numpy as np
import pytest

T = np.linspace(0.0, 24.0, 2401)
WAVE = {
    'disturbance_amplitude': 0.7, 'disturbance_omega': 2.0, 'disturbance_offset': -0.2,
    'disturbance_start': 4.005,
}  # fmt: skip
REST = {'order': 1, 'phi': ['0'], 'disturbance': 'none'}


def chirp(t):
    """Return the sine of the integral of an angular frequency that rises, then stays."""
    rising = np.minimum(t, 20.0)
    return np.sin(2.0 * rising + 0.45 * rising**2 + 20.0 * (t - rising))


FORMULAS = {
    'none': lambda t: 0.0 * t,
    'sine': lambda t: 0.7 * np.sin(2.0 * t) - 0.2,
    'step': lambda t: np.where(t >= 4.005, 0.7, 0.0) - 0.2,
    'square': lambda t: 0.7 * np.where(np.sin(2.0 * t) >= 0.0, 1.0, -1.0) - 0.2,
    'chirp': lambda t: 0.7 * chirp(t) - 0.2,
}


@pytest.mark.parametrize('kind', KINDS)
def test_disturbance_follows_its_formula_and_drives_the_last_state(kind):
    p = REST | WAVE | {'disturbance': kind, 'initial_state': 1.5, 'integration_step': 1e-3}
    t = np.linspace(0.0, 24.0, 24001)
    truth, d = Plant(p).simulate(t), FORMULAS[kind](t)
    np.testing.assert_allclose(truth.unknown_input, d, atol=1e-12)
    integral = 1.5 + np.concatenate([[0.0], np.cumsum(0.5e-3 * (d[1:] + d[:-1]))])
    # Each jump of d falls within one step: less than step * amplitude.
    close = 1e-5 if kind in ('sine', 'chirp') else 5e-3
    np.testing.assert_allclose(truth.z[:, 0], integral, atol=close)


def test_noise_is_seeded_white_and_of_the_right_size():
    p, t = REST | {'noise_std': 0.03}, np.linspace(0.0, 1.0, 100001)
    one, same, other = (Plant(p, noise_seed=seed).simulate(t) for seed in (5, 5, 6))
    noise = one.y - one.z[:, 0]
    np.testing.assert_array_equal(same.y, one.y)
    assert np.all(other.y != one.y)
    # Standard errors of the mean and of the deviation of 1e5 samples: 1e-4 and 7e-5.
    np.testing.assert_allclose(np.mean(noise), 0.0, atol=4e-4)
    np.testing.assert_allclose(np.std(noise), 0.03, atol=3e-4)
    np.testing.assert_allclose(np.mean(noise[1:] * noise[:-1]), 0.0, atol=1.2e-5)
    np.testing.assert_array_equal(one.z[:, 0], 0.2)  # the truth has none


@pytest.mark.filterwarnings('error')
def test_quantised_output_lies_on_the_grid_next_to_the_noisy_one():
    p = WAVE | {'noise_std': 0.1, 'disturbance': 'chirp'}
    fine, coarse = (Plant(p | {'quantisation': q}).simulate(T) for q in (0.0, 0.25))
    np.testing.assert_array_equal(coarse.y % 0.25, 0.0)
    assert 0.1 < np.max(np.abs(coarse.y - fine.y)) <= 0.125
    np.testing.assert_array_equal(coarse.z, fine.z)
    y = np.array([1e300, -1e300, 0.3, np.inf, np.nan])
    np.testing.assert_array_equal(quantised(y, 5e-324), y)  # far below y it changes nothing
    np.testing.assert_allclose(quantised(y, 1e-12)[:3], y[:3], rtol=1e-11)


def test_samples_equal_a_simulation_and_hardly_depend_on_who_looks():
    p = WAVE | {'noise_std': 0.1, 'disturbance': 'chirp', 'quantisation': 0.03}
    t = np.cumsum(np.random.default_rng(1).uniform(1e-5, 5e-3, 300))
    rows = list(map(Plant(p).sample, t))  # each a copy
    for found, wanted in zip(zip(*rows, strict=True), Plant(p).simulate(t), strict=True):
        np.testing.assert_array_equal(found, wanted)
    fewer = Plant(p).simulate(t[::7])
    np.testing.assert_allclose([row.z for row in rows[::7]], fewer.z, rtol=0.0, atol=1e-12)


def test_known_input_acts_during_the_interval_that_ends_at_its_time():
    t, u = np.array([0.0, 0.25, 0.4, 1.0]), np.array([9.0, 1.0, -2.0, 0.5])
    plant = Plant(REST | {'phi': ['u'], 'initial_state': 0.0})
    z, _ = respond(plant.model, [0.0], t, [0.0, 0.0], 1.0, u)
    for found in z, plant.simulate(t, u).z:
        np.testing.assert_allclose(found[:, 0], np.cumsum(u * np.diff(t, prepend=0)), atol=1e-12)


def test_live_change_acts_from_now_on():
    plant = Plant(REST | {'initial_state': 0.0})
    plant.advance(1.0)
    step = {'disturbance': 'step', 'disturbance_amplitude': 2, 'disturbance_start': 0}
    plant.adopt(plant.prepare(step), noise_anew=False)
    truth = plant.sample(2.0)
    np.testing.assert_allclose(truth.z, [2.0], rtol=1e-12)
    assert truth.unknown_input == 2.0
    noise = Plant(REST | {'noise_std': 1.0})
    first = [noise.sample(t).y for t in (0.1, 0.2, 0.3)]
    noise.adopt(noise.parameters, noise_anew=True)
    np.testing.assert_array_equal([noise.sample(t).y for t in (0.4, 0.5, 0.6)], first)


def test_refused_change_or_time_changes_nothing():
    plant = Plant()
    for change in {'noise_std': -1.0}, {'nois_std': 1.0}, {'initial_state': [9.0]}:
        with pytest.raises(ConfigurationError, match=next(iter(change))):
            plant.prepare({'disturbance_amplitude': 9.0} | change)
    for t in np.nan, np.inf, -np.inf:
        for call in (plant.advance, plant.sample, lambda t: plant.simulate([0.0, t])):
            with pytest.raises(ConfigurationError, match='expected finite time'):
                call(t)
    assert plant.parameters == Plant().parameters
    assert plant.sample(np.pi / 2.0).unknown_input == Plant().sample(np.pi / 2.0).unknown_input
    with pytest.raises(ConfigurationError, match=r"'initial_state'.*1 or 3 values.*\[1.0, 2.0\]"):
        Plant({'initial_state': [1.0, 2.0]})


SHORT = {'duration': 4.0, 'integration_step': 1e-3}


def test_recording_is_a_function_of_parameters_number_and_seed():
    several = Family(SHORT).recordings(4, seed=7)
    for ours, again in zip(several[2], Family(SHORT).recording(2, seed=7), strict=True):
        np.testing.assert_array_equal(ours, again)
    for family, seed in (Family(SHORT), 8), (Family(SHORT | {'noise_seed': 2}), 7):
        assert not np.array_equal(family.recording(2, seed).d, several[2].d)
    assert [r.shape for r in several] == ['sines', 'steps', 'chirp', 'sines']


def test_noise_quantisation_jitter_and_dropouts_are_as_asked():
    r = Family({
        'noise_std': 2e-3, 'period_jitter': 1e-4, 'stamp_jitter': 2e-4, 'dropout': 0.2,
        'dropout_length': 5.0, 'integration_step': 1e-3, 'duration': 60.0,
    }).recording(0)  # fmt: skip
    assert (np.diff(r.t) > 0.0).all()
    np.testing.assert_allclose(np.std(r.y - r.z[:, 0]), 2e-3, rtol=0.05)
    np.testing.assert_allclose(len(r.t) / 60_001, 0.8, rtol=0.05)
    runs = np.diff(r.t)[np.diff(r.t) > 2.5e-3] / 1e-3
    assert 3.0 < np.mean(runs) < 9.0
    off = r.t - np.round(r.t / 1e-3) * 1e-3
    np.testing.assert_allclose(np.std(off), np.hypot(1e-4, 2e-4), rtol=0.1)
    y = Family(SHORT | {'quantisation': 0.01}).recording(0).y
    np.testing.assert_allclose(y / 0.01, np.round(y / 0.01), atol=1e-9)
