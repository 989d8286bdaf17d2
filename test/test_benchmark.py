# SPDX-License-Identifier: Apache-2.0
"""The step in C that ours is compared with is the same step."""

import core_step
from fhaosmo_ros.core.observer.status import open_levels
import numpy as np
import pytest
from results import CannotMeasureError


def test_c_reference_takes_the_same_steps(tmp_path):
    """So that the ratio compares equal work, with all levels open and gamma moving."""
    y = core_step.output(20_001)
    try:
        expected, word_c = core_step.in_c(tmp_path, y)()
    except CannotMeasureError as error:
        pytest.skip(str(error))
    state, word = core_step.in_core(core_step.CASE, y)()
    np.testing.assert_allclose(state, expected, rtol=1e-9, atol=1e-15)
    assert word == word_c
    assert open_levels(word) == 4
    assert not np.isclose(state[16], 0.5)
