# SPDX-License-Identifier: Apache-2.0
"""Times of the samples of a run: order, units, resolution, shapes."""

from fhaosmo_ros.core import ConfigurationError, Observer
import numpy as np
from observer_cases import assert_same_state, laws, samples, SMALL, state_of
import pytest


@pytest.mark.parametrize('bad', [0.001, 0.0005, -1.0, np.nan, np.inf, -np.inf])
def test_times_that_do_not_increase_are_refused(bad):
    observer = Observer(SMALL)
    observer.run([0.0, 0.001], [0.1, 0.1], 0.0)
    before = state_of(observer)
    for t in ([0.002, bad, 0.003], [bad, 0.002, 0.003]):
        with pytest.raises(ConfigurationError, match=r'increase, got t\[[01]\] = '):
            observer.run(t, [0.1, 0.2, 0.3], 0.0)
    assert_same_state(state_of(observer), before)


@laws
def test_nanoseconds_equal_seconds(law):
    nanoseconds = np.cumsum(np.random.default_rng(2).integers(500_000, 2_000_000, 300))
    y = np.sin(3e-9 * nanoseconds)
    one = Observer(SMALL | law).run(nanoseconds, y, 0.0)
    other = Observer(SMALL | law).run(nanoseconds * 1e-9, y, 0.0)
    # Rounding of t only; sign's chatter would amplify it, explicitly.
    tolerance = 1e-6 if law['scheme'] == 'explicit' else 1e-9
    np.testing.assert_allclose(one.z, other.z, atol=tolerance)
    np.testing.assert_array_equal(one.t, nanoseconds)


@laws
@pytest.mark.parametrize('epoch', [1_700_000_000_000_000_000, 1_799_999_999_999_999_999])
@pytest.mark.parametrize('kind', [np.int64, np.uint64])
def test_nanoseconds_stay_exact_at_a_large_epoch(law, epoch, kind):
    steps = np.cumsum(np.random.default_rng(2).integers(500_000, 2_000_000, 300))
    y = np.sin(3e-9 * steps)
    near = Observer(SMALL | law).run(steps, y, 0.0)
    observer = Observer(SMALL | law)
    far = observer.run(steps[:150].astype(kind) + kind(epoch), y[:150], 0.0)
    far_on = observer.run(steps[150:].astype(kind) + kind(epoch), y[150:], 0.0)
    np.testing.assert_array_equal(np.concatenate([far.z, far_on.z]), near.z)


def test_arrays_that_do_not_fit_are_refused():
    observer = Observer(SMALL)
    before = state_of(observer)
    for arguments in (
        ([0.0, 1.0], [0.0]),
        ([[0.0, 1.0]], [[0.0, 1.0]]),
        ([0.0, 1.0], [0.0, 1.0], [0.0, 1.0, 2.0]),
        ([0.0, 1.0], [0.0, 1.0], 0.0, 0),
    ):
        with pytest.raises(ConfigurationError, match='expected'):
            observer.run(*arguments)
    assert_same_state(state_of(observer), before)


def test_empty_run_changes_nothing():
    observer = Observer(SMALL)
    assert observer.run([], [], 0.0).z.shape == (0, 2)
    observer.run(*samples())
    before = state_of(observer)
    assert observer.run([], [], 0.0).z.shape == (0, 2)
    assert_same_state(state_of(observer), before)
