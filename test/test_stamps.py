# SPDX-License-Identifier: Apache-2.0
"""Times of the samples of a run: order, units, resolution, shapes."""

from fhaosmo_ros.core import ConfigurationError, Observer, Status
import numpy as np
from observer_cases import assert_same_state, laws, samples, SMALL
import pytest


def test_backward_and_duplicate_stamps_are_rejected():
    t = np.array([0.0, 1.0, 1.0, 0.5, 2.0, 1.5, 3.0]) * 1e-3
    result = Observer(SMALL).run(t, np.linspace(0.1, 0.2, 7))
    late = (result.status & Status.REJECTED_PERIOD) != 0
    np.testing.assert_array_equal(late, [0, 0, 1, 1, 0, 1, 0])
    good = Observer(SMALL).run(t[~late], np.linspace(0.1, 0.2, 7)[~late])
    np.testing.assert_array_equal(result.z[~late], good.z)


@pytest.mark.parametrize('stamp', [np.nan, np.inf, -np.inf])
def test_stamp_that_is_not_finite_spoils_its_own_sample_only(stamp):
    t = np.arange(6) * 1e-3
    bad = t.copy()
    bad[2] = stamp
    y = np.linspace(0.1, 0.2, 6)
    result = Observer(SMALL).run(bad, y)
    late = (result.status & Status.REJECTED_PERIOD) != 0
    np.testing.assert_array_equal(late, [0, 0, 1, 0, 0, 0])
    good = Observer(SMALL).run(np.delete(t, 2), np.delete(y, 2))
    np.testing.assert_array_equal(result.z[~late], good.z)


def test_stamp_of_a_sample_before_the_first_good_one_does_not_count():
    result = Observer(SMALL).run([5.0, 1.0, 1.001], [np.nan, 0.1, 0.1])
    assert not result.status[2] & Status.REJECTED_PERIOD


@laws
def test_nanoseconds_equal_seconds(law):
    nanoseconds = np.cumsum(np.random.default_rng(2).integers(500_000, 2_000_000, 300))
    y = np.sin(3e-9 * nanoseconds)
    one = Observer(SMALL | law).run(nanoseconds, y)
    other = Observer(SMALL | law).run(nanoseconds * 1e-9, y)
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
    near = Observer(SMALL | law).run(steps, y)
    observer = Observer(SMALL | law)
    far = observer.run(steps[:150].astype(kind) + kind(epoch), y[:150])
    far_on = observer.run(steps[150:].astype(kind) + kind(epoch), y[150:])
    np.testing.assert_array_equal(np.concatenate([far.z, far_on.z]), near.z)


def test_arrays_that_do_not_fit_are_refused():
    observer = Observer(SMALL)
    before = observer.state
    for arguments in (
        ([0.0, 1.0], [0.0]),
        ([[0.0, 1.0]], [[0.0, 1.0]]),
        ([0.0, 1.0], [0.0, 1.0], [0.0, 1.0, 2.0]),
        ([0.0, 1.0], [0.0, 1.0], 0.0, 0),
    ):
        with pytest.raises(ConfigurationError, match='expected'):
            observer.run(*arguments)
    assert_same_state(observer.state, before)


def test_empty_run_changes_nothing():
    observer = Observer(SMALL)
    assert observer.run([], []).z.shape == (0, 2)
    observer.run(*samples())
    before = observer.state
    assert observer.run([], []).z.shape == (0, 2)
    assert_same_state(observer.state, before)
