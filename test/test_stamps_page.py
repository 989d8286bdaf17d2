# SPDX-License-Identifier: Apache-2.0
"""Inexact stamps and gaps: docs/stamps.json is what the study measures."""

import json

import numpy as np
import pytest
from studies import stamps


@pytest.fixture(scope='module')
def results():
    return json.loads(stamps.PAGE.with_stem(stamps.NAME).with_suffix('.json').read_text())


def test_the_study_still_measures_it(results):
    """In cells where no restart makes the error depend on the last bit."""
    name, gains = next(iter(stamps.shown_gains().items()))
    assert stamps.jitter_errors(gains) == pytest.approx(results['jitter'][name], rel=0.05)
    kept = results['clock'][name]['1 kHz'][:2]
    assert stamps.clock_errors(gains, 1)[:2] == pytest.approx(kept, rel=0.05)
    name, (changes, omega) = list(stamps.GAPPED.items())[-1]
    kept = results['gaps'][name]['100']
    assert stamps.gap_errors(changes, omega, 100) == pytest.approx(kept, rel=0.05)


def test_a_clock_that_is_not_late_reads_the_time_of_the_tick():
    published = stamps.nanoseconds(np.arange(1000) * 1e-3)
    np.testing.assert_array_equal(stamps.clock_readings(published, 1, 0.0, 0), published)
    np.testing.assert_array_equal(
        stamps.clock_readings(published, 25, 0.0, 0), published[::25].repeat(25)
    )
    late = stamps.clock_readings(published, 25, 1e-3, 0)
    assert (np.diff(late) >= 0).all()
    assert np.any(late != published[::25].repeat(25))
