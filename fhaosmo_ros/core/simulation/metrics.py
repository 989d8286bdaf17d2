# SPDX-License-Identifier: Apache-2.0
"""How good an estimate is, in numbers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Series = NDArray[np.float64]


def rms(error: Series) -> Any:
    """Return the root mean square of a series, or of each column of a table; NaN if empty."""
    return np.sqrt(np.mean(np.square(error), axis=0)) if len(error) else np.nan


def chatter(estimate: Series, truth: Series) -> float:
    """
    Return the total variation of the estimate, the sum of |x[k + 1] - x[k]|, over the truth's.

    About 1 for an estimate that moves as the truth does; chatter makes it large.
    """
    variation, reference = (float(np.sum(np.abs(np.diff(x)))) for x in (estimate, truth))
    return variation / reference if reference > 0.0 else float('inf')
