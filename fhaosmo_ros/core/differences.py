# SPDX-License-Identifier: Apache-2.0
"""Backward differences: how a correction of y is shared out among its derivatives (D 18)."""

import numpy as np
from numpy.typing import NDArray


def shares(count: int) -> NDArray[np.float64]:
    """
    Return the weights of a correction that is deadbeat for a chain of integrators.

    The i-th derivative's backward difference formula is (-ln(1 - B))^i / h^i, B y_k = y_k -
    y_{k-1}. Cut off after B^j it is exact for polynomials of degree j. Row j of the result says
    what a chain of j + 1 integrators has to take over of a prediction error of its first state,
    so that such a polynomial is known exactly after j + 1 samples.

    Parameters
    ----------
    count : int
        Largest number of integrators.

    Returns
    -------
    (count, count) array
        Weight of the error / h^i in the i-th derivative, row j; 0 for i > j.

    """
    logarithm = np.zeros(count)  # of the power series -ln(1 - x)
    logarithm[1:] = 1.0 / np.arange(1, count)
    power = np.eye(count)[0]
    result = np.zeros((count, count))
    for i in range(count):
        result[:, i] = np.cumsum(power)
        power = np.convolve(power, logarithm)[:count]
    return result
