# SPDX-License-Identifier: Apache-2.0
"""The step in C that ours is compared with is the same step."""

from fhaosmo_ros.core.observer.status import open_levels
import numpy as np
import pytest
import reference
from results import CannotMeasureError


def test_c_reference_takes_the_same_steps(tmp_path):
    """So that the ratio compares equal work, with all levels open and gamma moving."""
    try:
        library = reference.compile_reference(tmp_path)
    except CannotMeasureError as error:
        pytest.skip(str(error))
    y = reference.output(20_001)
    reference.assert_agreement(library, y)
    state, word = reference.in_core(reference.CASE, y)()
    assert open_levels(word) == 4
    assert not np.isclose(state[16], 0.5)
