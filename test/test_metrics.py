# SPDX-License-Identifier: Apache-2.0
"""Metrics on series whose numbers are known by hand."""

from fhaosmo_ros.core.simulation.metrics import chatter, rms, total_variation
import numpy as np


def test_rms():
    np.testing.assert_allclose(rms(np.array([3.0, -4.0])), np.sqrt(12.5))
    assert np.isnan(rms(np.array([])))
    assert np.isnan(rms(np.array([1.0, np.nan])))


def test_chatter_is_total_variation_over_that_of_the_truth():
    assert total_variation(np.array([0.0, 2.0, -1.0, -1.0])) == 5.0
    assert total_variation(np.array([4.0])) == 0.0
    truth = np.sin(np.linspace(0.0, 10.0, 1001))
    np.testing.assert_allclose(chatter(0.5 * truth + 3.0, truth), 0.5)
    # +-0.1 at every sample adds 0.2 a step to a variation of about 0.01 * |cos|.
    noisy = truth + 0.1 * (-1.0) ** np.arange(1001)
    np.testing.assert_allclose(chatter(noisy, truth), 200.0 / total_variation(truth), rtol=1e-3)
    assert chatter(noisy, np.ones(1001)) == np.inf
