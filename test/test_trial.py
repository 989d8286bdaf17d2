# SPDX-License-Identifier: Apache-2.0
"""The compiled judgement says what the node's estimator and the metrics say, sample for sample."""

from concurrent.futures import ThreadPoolExecutor

from fhaosmo_ros.core import ConfigurationError, Family, Trial
from fhaosmo_ros.core.observer.status import REJECTED, Status
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms, total_variation
import numpy as np
import pytest

GAINS = {'lambda': [3.0, 2.0, 2.0, 0.5], 'alpha': [2.0, 1.0, 2.0, 1.5], 'epsilon': 40.0,
         'fuzzy_widths': [0.11, 0.05, 0.59, 0.34]}  # fmt: skip
SETTLED, BAND = 2.0, 0.07


@pytest.fixture(scope='module', name='recordings')
def _recordings():
    family = Family(
        {'duration': 5.0, 'noise_std': 1e-3, 'integration_step': 1e-3, 'dropout': 0.05}
    )
    return family.recordings(3)


def estimates(recording, values):
    """Return what the node's estimator makes of a recording, a row for each sample."""
    stamps = 10**9 + np.round(recording.t * 1e9).astype(np.int64)
    return OnlineEstimator(values).run(stamps, recording.y, recording.u)


@pytest.mark.parametrize('scheme', ['implicit', 'explicit'])
@pytest.mark.parametrize('variant', ['sign', 'fuzzy', 'fuzzy_adaptive'])
@pytest.mark.parametrize('unknown_input', [True, False])
def test_scores_are_those_of_estimator_and_metrics(recordings, scheme, variant, unknown_input):
    n = 3 + unknown_input
    fixed = {'scheme': scheme, 'variant': variant, 'unknown_input': unknown_input}
    gains = {k: v if k == 'epsilon' else v[:n] for k, v in GAINS.items()}
    trial = Trial(recordings, fixed, SETTLED, BAND)
    scores = trial(gains)
    for choice, estimate_from in enumerate(('internal', 'filtered')):
        for k, r in enumerate(recordings):
            e = estimates(r, fixed | gains | {'estimate_from': estimate_from})
            late = r.t - r.t[0] >= SETTLED
            expected = [rms((e.z - r.z)[late, i]) for i in range(3)]
            wrong = e.unknown_input - r.d
            expected.append(rms(wrong[late]))
            np.testing.assert_allclose(scores.error[k, choice], expected, rtol=1e-9)
            np.testing.assert_allclose(
                scores.variation[k, choice], total_variation(e.unknown_input[late]), rtol=1e-9
            )
            bad = r.t[~late & (np.abs(wrong) > BAND)] - r.t[0]
            last = bad[-1] if len(bad) else 0.0
            assert scores.transient[k, choice] == pytest.approx(last, abs=1e-9)


def test_gap_restarts_as_in_the_node():
    recording = Family({'duration': 5.0, 'integration_step': 1e-3}).recording(0)
    keep = (recording.t < 2.5) | (recording.t > 3.2)
    r = type(recording)(*(part[keep] for part in recording[:5]), recording.shape)
    run = estimates(r, GAINS)
    # The first sample after the gap is held until the next one speaks for it.
    assert ((run.status & REJECTED) != 0).sum() == 1
    late = r.t >= SETTLED
    expected = rms((run.unknown_input - r.d)[late])
    error = Trial([r], {}, SETTLED, BAND)(GAINS).error[0, 0, -1]
    np.testing.assert_allclose(error, expected, rtol=1e-9)
    other = Trial([r], {'max_gap': 1.0}, SETTLED, BAND)(GAINS).error[0, 0, -1]
    assert not np.allclose(other, expected)


@pytest.mark.parametrize('scheme', ['implicit', 'explicit', 'predict_correct'])
def test_losses_are_taken_as_in_the_node(scheme):
    """predict_correct steps through a gap at once; for the other schemes it is bridged."""
    r = Family(
        {'duration': 5.0, 'noise_std': 1e-3, 'integration_step': 1e-3, 'dropout': 0.2,
         'dropout_length': 20.0}
    ).recording(0)  # fmt: skip
    values = {'scheme': scheme, **GAINS}
    if scheme == 'predict_correct':
        values = {
            'structure': 'levant', 'scheme': scheme, 'gamma_rate': 0.0, 'gamma_min': 1e-4,
            'gamma_initial': 3e-3, 'correction_period': 1e-3,
            'lambda': [153.0, 698.0, 1590.0, 2490.0], 'fuzzy_widths': [31.0],
        }  # fmt: skip
    run = estimates(r, values)
    assert ((run.status & Status.GAP) != 0).sum() > 10
    assert not (run.status & REJECTED).any()
    late = r.t >= SETTLED
    expected = [*(rms((run.z - r.z)[late, k]) for k in range(3)),
                rms((run.unknown_input - r.d)[late])]  # fmt: skip
    scores = Trial([r], values, SETTLED, BAND)({})
    np.testing.assert_allclose(scores.error[0, 0], expected, rtol=1e-9)


def test_threads_do_not_disturb_one_another(recordings):
    trial = Trial(recordings, {}, SETTLED, BAND)
    changes = [GAINS | {'epsilon': 10.0 ** (k % 4 - 2)} for k in range(16)]
    expected = [trial(change).error for change in changes]
    with ThreadPoolExecutor(4) as pool:
        actual = list(pool.map(lambda change: trial(change).error, changes))
    np.testing.assert_array_equal(actual, expected)
    assert not np.array_equal(expected[0], expected[3])


def test_scale_and_variation_of_the_truth(recordings):
    trial = Trial(recordings, {}, SETTLED, BAND)
    late = np.concatenate([r.d[r.t - r.t[0] >= SETTLED] for r in recordings])
    np.testing.assert_allclose(trial.scale[-1], rms(late))
    one = recordings[1]
    np.testing.assert_allclose(
        trial.variation[1], total_variation(one.d[one.t - one.t[0] >= SETTLED])
    )


@pytest.mark.parametrize(
    ('settled', 'parameters', 'message'),
    [
        (5.0, {}, 'more than 5 s'),
        (1.0, {'order': 2, 'phi': ['0', '0']}, 'the 2 states of the model.*got 3'),
    ],
)
def test_recordings_that_do_not_fit(recordings, settled, parameters, message):
    with pytest.raises(ConfigurationError, match=message):
        Trial(recordings, parameters, settled, BAND)
    with pytest.raises(ConfigurationError, match='at least one recording'):
        Trial([], {}, 1.0, BAND)


def test_every_observer_parameter_can_be_judged(recordings):
    """A parameter that the judgement passed over would make a search in it pointless."""
    trial = Trial(recordings, {}, SETTLED, BAND)
    assert set(OBSERVER_PARAMETERS) >= set(GAINS)
    base = trial(GAINS).error
    for name, value in [('lambda', [9.0]), ('alpha', [9.0]), ('epsilon', 1e-3),
                        ('fuzzy_widths', [1.0]), ('gamma_initial', 0.4)]:  # fmt: skip
        assert not np.array_equal(trial(GAINS | {name: value}).error, base), name
