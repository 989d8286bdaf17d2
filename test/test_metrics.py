# SPDX-License-Identifier: Apache-2.0
"""Metrics on series whose numbers are known by hand."""

from fhaosmo_ros.core.simulation.metrics import chatter, rms, total_variation
import numpy as np
import pytest
from studies.paper.cases import settling_time


def test_rms():
    np.testing.assert_allclose(rms(np.array([3.0, -4.0])), np.sqrt(12.5))
    assert np.isnan(rms(np.array([])))
    assert np.isnan(rms(np.array([1.0, np.nan])))


@pytest.mark.parametrize(
    ('error', 'expected'),
    [
        ([0.0, 0.0, 0.0, 0.0], 0.0),
        ([9.0, 0.0, 0.0, 0.0], 0.5),
        ([9.0, -9.0, 1.0, -1.0], 1.0),  # the band's edge belongs to it
        ([0.0, 0.0, 9.0, 0.0], 1.5),  # the last time that it comes back
        ([0.0, 0.0, np.nan, 0.0], 1.5),  # unknown is not within
        ([0.0, 0.0, 0.0, 9.0], np.inf),
        ([9.0, 0.0, 0.0, np.nan], np.inf),
    ],
)
def test_settling_time(error, expected):
    t = np.array([10.0, 10.5, 11.0, 11.5])
    assert settling_time(t, np.array(error), 1.0) == expected


def test_chatter_is_total_variation_over_that_of_the_truth():
    assert total_variation(np.array([0.0, 2.0, -1.0, -1.0])) == 5.0
    assert total_variation(np.array([4.0])) == 0.0
    truth = np.sin(np.linspace(0.0, 10.0, 1001))
    np.testing.assert_allclose(chatter(0.5 * truth + 3.0, truth), 0.5)
    # +-0.1 at every sample adds 0.2 a step to a variation of about 0.01 * |cos|.
    noisy = truth + 0.1 * (-1.0) ** np.arange(1001)
    np.testing.assert_allclose(chatter(noisy, truth), 200.0 / total_variation(truth), rtol=1e-3)
    assert chatter(noisy, np.ones(1001)) == np.inf
