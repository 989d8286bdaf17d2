# SPDX-License-Identifier: Apache-2.0
"""Training recordings: seeded, true to their parameters, and solved accurately."""

from fhaosmo_ros.core import ConfigurationError, Family, Plant, TriangularModel
from fhaosmo_ros.core.simulation.plant import respond
import numpy as np
import pytest

SHORT = {'duration': 4.0, 'integration_step': 1e-3}


def test_recording_is_a_function_of_parameters_number_and_seed():
    several = Family(SHORT).recordings(4, seed=7)
    for ours, again in zip(several[2], Family(SHORT).recording(2, seed=7), strict=True):
        np.testing.assert_array_equal(ours, again)
    for family, seed in (Family(SHORT), 8), (Family(SHORT | {'noise_seed': 2}), 7):
        assert not np.array_equal(family.recording(2, seed).d, several[2].d)
    assert [r.shape for r in several] == ['sines', 'steps', 'chirp', 'sines']


@pytest.mark.parametrize('shape', ['sines', 'steps', 'chirp'])
def test_d_has_its_size_stays_in_its_band_and_is_not_one_sine(shape):
    d = Family({
        'rms_of_d': 0.3, 'band_of_d': [2.0, 6.0], 'disturbances': [shape], 'duration': 60.0,
        'integration_step': 1e-3, 'sample_rate': 100.0,
    }).recording(0).d  # fmt: skip
    np.testing.assert_allclose(np.sqrt(np.mean(d**2)), 0.3, rtol=0.05)
    power = np.abs(np.fft.rfft(d * np.hanning(len(d)))) ** 2
    omega = 2.0 * np.pi * np.fft.rfftfreq(len(d), 0.01)
    parts, _ = np.histogram(omega, [1.7, 2.9, 4.2, 6.5], weights=power)
    if shape != 'steps':
        assert parts.sum() > 0.99 * power.sum()
        assert parts.min() > 0.02 * power.sum()


def test_response_is_that_of_the_plant():
    """Between the table's points d is a line: its error is (omega spacing)^2 / 8 of d."""
    t = np.arange(0.0, 5.0, 1e-3)
    table = 0.1 * np.sin(3.0 * np.arange(0.0, 5.1, 1e-4))
    model = TriangularModel(['0', '0', '-z3'])
    z, d = respond(model, [0.2, 0.2, 0.2], t, table, 1e-4)
    truth = Plant({'disturbance_omega': 3.0, 'initial_state': 0.2}).simulate(t)
    np.testing.assert_allclose(z, truth.z, atol=1e-7)
    np.testing.assert_allclose(d, truth.unknown_input, atol=1e-8)


def test_known_input_is_held_during_the_interval_that_ends_at_its_sample():
    t = np.array([0.0, 0.25, 0.4, 1.0])
    u = np.array([9.0, 1.0, -2.0, 0.5])
    z, _ = respond(TriangularModel(['u']), [0.0], t, [0.0, 0.0], 1.0, u)
    np.testing.assert_allclose(z[:, 0], np.cumsum(u * np.diff(t, prepend=0.0)), atol=1e-12)


def test_noise_quantisation_jitter_and_dropouts_are_as_asked():
    family = Family(
        {'noise_std': 2e-3, 'period_jitter': 1e-4, 'stamp_jitter': 2e-4, 'dropout': 0.2,
         'dropout_length': 5.0, 'integration_step': 1e-3, 'duration': 60.0}
    )  # fmt: skip
    r = family.recording(0)
    assert (np.diff(r.t) > 0.0).all()
    np.testing.assert_allclose(np.std(r.y - r.z[:, 0]), 2e-3, rtol=0.05)
    np.testing.assert_allclose(len(r.t) / 60_001, 0.8, rtol=0.05)
    runs = np.diff(r.t)[np.diff(r.t) > 2.5e-3] / 1e-3
    assert 3.0 < np.mean(runs) < 9.0
    off = r.t - np.round(r.t / 1e-3) * 1e-3
    np.testing.assert_allclose(np.std(off), np.hypot(1e-4, 2e-4), rtol=0.1)
    y = Family(SHORT | {'quantisation': 0.01}).recording(0).y
    np.testing.assert_allclose(y / 0.01, np.round(y / 0.01), atol=1e-9)


@pytest.mark.parametrize(('parameters', 'message'), [
    ({'band_of_d': [3.0, 1.0]}, 'band_of_d.*lower one first'), ({'band_of_d': [3.0]}, 'band_of_d'),
    ({'disturbances': ['sine']}, "disturbances.*did you mean 'sines'|disturbances.*sines"),
    ({'noise': 1.0}, 'noise'),
    (SHORT | {'phi': ['0', '0', 'z3**3'], 'rms_of_d': 100.0}, 'stay finite'),
])  # fmt: skip
def test_bad_family_is_one_line(parameters, message):
    with pytest.raises(ConfigurationError, match=message) as error:
        Family(parameters).recording(0)
    assert '\n' not in str(error.value)
