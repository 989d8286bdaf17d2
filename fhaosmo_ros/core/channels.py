# SPDX-License-Identifier: Apache-2.0
"""
Many estimators stepped in one compiled call, each through the policy of a single one.

The estimators keep their own arrays, of whatever size. A table says where these lie, so a call
costs the same whether it steps one channel or fifty.
"""

from collections.abc import Sequence
from typing import Any

from fhaosmo_ros.core.borrowed import doubles_at, integers_at
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.policy import take_once
from fhaosmo_ros.core.tape import Floats, Ints
from numba import njit
import numpy as np
from numpy.typing import NDArray

(
    EPS, INTS, REALS, FLAGS, GAINS, CURVES, SCALARS, TAPE, OFFSETS, X, M, STACK, LEVELS, MEMORY,
    UNKNOWN_INPUT,
) = range(15)  # fmt: skip
"""What the table tells the place of: arguments of `take_once`, and the estimate of d."""


@njit(cache=True, error_model='numpy')
def take_many(
    table: Ints, channel: Ints, stamps: Ints, y: Floats, u: Floats,
    words: Ints, unknown_inputs: Floats,
) -> None:  # fmt: skip
    """
    Take samples in order, each by the estimator of its channel.

    Parameters
    ----------
    table : (m, 15, 3) array
        Address, rows and columns of each array of each channel; 0 rows for one dimension.
    channel, stamps, y, u : (K,) arrays
        Of each sample.
    words, unknown_inputs : (K,) arrays
        Get the status word and the estimate of d after each sample.

    """
    for k in range(y.shape[0]):
        t = table[channel[k]]
        words[k] = take_once(
            stamps[k], y[k], u[k],
            doubles_at(t[EPS, 0], (t[EPS, 1], t[EPS, 2])),
            integers_at(t[INTS, 0], t[INTS, 2]),
            doubles_at(t[REALS, 0], t[REALS, 2]),
            integers_at(t[FLAGS, 0], t[FLAGS, 2]),
            doubles_at(t[GAINS, 0], (t[GAINS, 1], t[GAINS, 2])),
            doubles_at(t[CURVES, 0], (t[CURVES, 1], t[CURVES, 2])),
            doubles_at(t[SCALARS, 0], t[SCALARS, 2]),
            doubles_at(t[TAPE, 0], (t[TAPE, 1], t[TAPE, 2])),
            integers_at(t[OFFSETS, 0], t[OFFSETS, 2]),
            doubles_at(t[X, 0], (t[X, 1], t[X, 2])),
            doubles_at(t[M, 0], (t[M, 1], t[M, 2])),
            doubles_at(t[STACK, 0], (t[STACK, 1], t[STACK, 2])),
            doubles_at(t[LEVELS, 0], (t[LEVELS, 1], t[LEVELS, 2])),
            doubles_at(t[MEMORY, 0], t[MEMORY, 2]),
        )  # fmt: skip
        unknown_inputs[k] = doubles_at(t[UNKNOWN_INPUT, 0], 1)[0]


class Channels:
    """
    Estimators that take their samples in one call.

    Parameters
    ----------
    estimators : sequence of OnlineEstimator
        Channel c is the c-th one. They remain usable by themselves.

    """

    def __init__(self, estimators: Sequence[OnlineEstimator]) -> None:
        self._estimators = list(estimators)
        self._arguments: list[tuple[Any, ...]] = [()] * len(self._estimators)
        self._table = np.zeros((len(self._estimators), UNKNOWN_INPUT + 1, 3), dtype=np.int64)

    def advance(
        self, channel: Sequence[int], stamps: Sequence[int], y: Sequence[float], u: Sequence[float]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """
        Take samples in order, bit for bit as their estimators would take them one by one.

        Parameters
        ----------
        channel : sequence of int
            Which estimator takes each sample.
        stamps, y, u : sequences
            Of each sample; u is finite.

        Returns
        -------
        (K,) array of int, (K,) array
            Status word, and estimate of d, after each sample.

        """
        for c, estimator in enumerate(self._estimators):
            if estimator.arguments is not self._arguments[c]:
                self._place(c, estimator)
        numbers = np.array(channel, dtype=np.int64)
        words = np.empty(len(numbers), dtype=np.int64)
        unknown_inputs = np.empty(len(numbers))
        take_many(
            self._table, numbers, np.array(stamps, dtype=np.int64),
            np.array(y, dtype=np.float64), np.array(u, dtype=np.float64), words, unknown_inputs,
        )  # fmt: skip
        for c, word in dict(zip(channel, words.tolist(), strict=True)).items():
            self._estimators[c].taken(word)
        return words, unknown_inputs

    def _place(self, c: int, estimator: OnlineEstimator) -> None:
        """Write where a channel's arrays are; holding them keeps them there."""
        self._arguments[c] = estimator.arguments
        for index, array in enumerate(estimator.arguments):
            if not array.flags.c_contiguous:
                raise AssertionError(f'argument {index} of a channel is not contiguous')
            rows, columns = array.shape if array.ndim == 2 else (0, array.size)
            self._table[c, index] = array.ctypes.data, rows, columns
        self._table[c, UNKNOWN_INPUT, 0] = estimator.observer.unknown_input_address
