# SPDX-License-Identifier: Apache-2.0
"""Samples that no sensor should send: rejected, reported, and without harm to what follows."""

from fhaosmo_ros.core import ConfigurationError, Observer, Status
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from observer_cases import any_law, cascades, laws, levels_of, remembered, SMALL, state_of
import pytest

USABLE = 1e-8 * np.finfo(float).max
"""Beyond this, numbers count as infinite."""
STEEP = {
    'order': 1, 'phi': ['-z1**7'], 'lambda': [740.0], 'alpha': [155.0], 'epsilon': 80.0,
    'fuzzy_widths': [0.1],
}  # fmt: skip
wild = st.floats() | st.sampled_from([0.0, 1e-320, 1e-300, 1e150, 1e300, 1.797e308, -1.797e308])
wild_sample = st.tuples(wild, st.floats(1e-6, 0.1) | wild, st.floats(-1.0, 1.0) | wild)


@given(any_law, st.lists(wild_sample, max_size=8))
def test_state_stays_finite_and_rejected_samples_leave_it_alone(law, inputs):
    observer, cautious = Observer(SMALL | law), Observer(SMALL | law)
    for one in (observer, cautious):
        one.start(0.3)
    for y, dt, u in inputs:
        before = state_of(observer)
        estimate = observer.structure.update(y, dt, u)
        values = [*observer.structure.state_dict().values(), estimate.z, estimate.innovation]
        assert all(np.isfinite(value).all() for value in [*values, estimate.unknown_input])
        assert 1 <= estimate.open_levels <= 3
        status = estimate.status
        assert bool(status & Status.REJECTED_PERIOD) == (not 0.0 < dt < USABLE)
        assert bool(status & Status.REJECTED_INPUT) == (not np.isfinite(u))
        assert bool(status & Status.REJECTED_MEASUREMENT) == (not abs(y) < USABLE)
        if status.rejected:
            for name in ('z_hat', 'z_tilde', 'p', 'q', 'gamma'):
                np.testing.assert_array_equal(remembered(observer, name), before[name])
        else:
            assert (remembered(observer, 'y'), remembered(observer, 'pending')) == (y, 0.0)
        # A wild sample that is accepted is the truth, and the state goes where it leads; one that
        # is not leaves no trap behind.
        before = state_of(cautious)
        if not cautious.structure.update(y, dt, u).status.rejected:
            cautious.structure.load_state_dict(before)
    cautious.step(0.3, 1e-3, 0.0)
    assert not cautious.step(0.3, 1e-3, 0.0).status.rejected


@laws
def test_time_of_a_rejected_sample_is_carried_over(law):
    one, other = Observer(SMALL | law), Observer(SMALL | law)
    for observer in (one, other):
        observer.start(0.3)
        observer.step(0.31, 1e-3, 0.0)
    assert one.step(-np.inf, 2e-3, 0.0).status == Status.REJECTED_MEASUREMENT
    assert one.step(0.35, 1e-3, np.nan).status == Status.REJECTED_INPUT
    assert one.structure.update(0.35, -1.0).status == Status.REJECTED_PERIOD
    for dt in (0.0, -0.0, -1e-3, np.nan, np.inf, -np.inf):
        with pytest.raises(ConfigurationError, match='dt > 0'):
            one.step(0.3, dt, 0.0)
    np.testing.assert_allclose(remembered(one, 'pending'), 3e-3)
    one.step(0.4, 2e-3, 0.0)
    other.step(0.4, 2e-3 + 1e-3 + 2e-3, 0.0)
    np.testing.assert_allclose(levels_of(one), levels_of(other), rtol=1e-12)
    assert remembered(one, 'pending') == 0.0


def test_samples_before_the_first_good_one():
    observer = Observer(SMALL | {'initial_estimate': [0.5, 0.1, 0.0]})
    assert observer.start(np.nan).status == Status.REJECTED_MEASUREMENT
    assert observer.step(np.inf, 1e-3, 0.0).status == Status.REJECTED_MEASUREMENT
    assert not observer.started
    result = observer.run([0.0, 0.1], [np.nan, 2.0], 0.0)
    np.testing.assert_array_equal(result.z[:, 0], [0.5, 2.0])  # not before it has come
    assert result.status[0] == Status.REJECTED_MEASUREMENT
    assert not result.status[1] & Status.REJECTED_MEASUREMENT


@cascades
def test_time_that_no_step_can_take_is_dropped(law):
    observer = Observer(STEEP | law | {'unknown_input': False})
    observer.start(5.0)
    assert observer.step(np.nan, 1e299, 0.0).status == Status.REJECTED_MEASUREMENT
    # Implicitly sign slides over any time: its step exists.
    slides = law['scheme'] == 'implicit' and law['variant'].startswith('sign')
    assert bool(observer.step(5.0, 1e-3, 0.0).status & Status.REJECTED_STEP) != slides
    assert remembered(observer, 'pending') == 0.0
    assert not observer.step(5.0, 1e-3, 0.0).status.rejected
