# SPDX-License-Identifier: Apache-2.0
"""
Many estimators stepped in one compiled call, each through the policy of a single one.

The estimators keep their own arrays, of whatever size. A table says where these lie, so a call
costs the same whether it steps one channel or fifty.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import (
    doubles_at,
    integers_of,
    line_at,
    plane_at,
    table_of,
)
from fhaosmo_ros.core.model.bytecode import Floats, Ints
from fhaosmo_ros.core.observer.arrays import ARRAYS, observer_at
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy
from fhaosmo_ros.core.online.policy import take
import numpy as np
from numpy.typing import NDArray

EPS, INTS, REALS, OBSERVER = range(4)
UNKNOWN_INPUT = OBSERVER + ARRAYS
"""Index in the table: the arrays of `OnlineEstimator.arguments`, then the estimate of d."""


class ChannelSamples(NamedTuple):
    """
    Samples of several channels in the order in which they came.

    Attributes
    ----------
    channel, stamps, y : (K,) arrays
    u : (K, m) array
        Known inputs; a channel with fewer than m reads the first ones of a row.

    """

    channel: Ints
    stamps: Ints
    y: Floats
    u: Floats


@compiled(inline='always')
def arrays_at(t: Ints) -> EstimatorArrays:
    """Return the arrays of the estimator that a channel's part of the table names."""
    law, work, state = observer_at(t, OBSERVER)
    return EstimatorArrays(law, work, state, Policy(integers_of(t, INTS), line_at(t, REALS)))


@compiled()
def take_many(table: Ints, samples: ChannelSamples, words: Ints, unknown_inputs: Floats) -> None:
    """
    Take samples in order, each by the estimator of its channel.

    Parameters
    ----------
    table : (m, 16, 3) array
        Address, rows (of two dimensions) and columns of each array of each channel.
    samples : ChannelSamples
        K samples.
    words, unknown_inputs : (K,) arrays
        Get the status word and the estimate of d after each sample.

    """
    for k in range(samples.y.shape[0]):
        t = table[samples.channel[k]]
        words[k] = take(
            arrays_at(t), samples.stamps[k], samples.y[k], samples.u[k], plane_at(t, EPS), 0
        )
        unknown_inputs[k] = doubles_at(t[UNKNOWN_INPUT, 0], 1)[0]


class EstimatorBatch:
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
        self,
        channel: Sequence[int],
        stamps: Sequence[int],
        y: Sequence[float],
        u: Sequence[float | Sequence[float]],
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """
        Take samples in order, bit for bit as their estimators would take them one by one.

        Parameters
        ----------
        channel : sequence of int
            Which estimator takes each sample.
        stamps, y : sequences
            Of each sample.
        u : sequence of numbers or sequences
            Known inputs of each sample, all finite, as many as its estimator has; just a number
            where no estimator has more than one.

        Returns
        -------
        (K,) array of int, (K,) array
            Status word, and estimate of d, after each sample.

        """
        if any(estimator.smooths or estimator.events.on for estimator in self._estimators):
            return self._one_by_one(zip(channel, stamps, y, u, strict=True))
        for c, estimator in enumerate(self._estimators):
            if estimator.arguments is not self._arguments[c]:
                self._place(c, estimator)
        numbers = np.array(channel, dtype=np.int64)
        words = np.empty(len(numbers), dtype=np.int64)
        unknown_inputs = np.empty(len(numbers))
        samples = ChannelSamples(
            numbers,
            np.array(stamps, dtype=np.int64),
            np.array(y, dtype=np.float64),
            self._padded(u),
        )
        take_many(self._table, samples, words, unknown_inputs)
        for c, word in dict(zip(channel, words.tolist(), strict=True)).items():
            self._estimators[c].taken(word)
        return words, unknown_inputs

    def _one_by_one(
        self, samples: Iterable[tuple[int, int, float, float | Sequence[float]]]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Do the same where an estimator smooths or finds events, which a batch can't."""
        words, unknown_inputs = [], []
        for c, stamp, value, inputs in samples:
            estimator = self._estimators[c]
            for k, number in enumerate(np.atleast_1d(inputs)[: len(estimator.inputs)]):
                estimator.set_input(float(number), k)
            words.append(estimator.advance(stamp, value))
            unknown_inputs.append(estimator.observer.unknown_input)
        return np.array(words, dtype=np.int64), np.array(unknown_inputs)

    def _padded(self, u: Sequence[Any]) -> Floats:
        """Return the known inputs as an array, zeros behind the shorter rows."""
        width = max(len(estimator.observer.inputs) for estimator in self._estimators)
        if width > 1:
            u = [[*row, *[0.0] * (width - len(row))] for row in u]
        return np.array(u, dtype=np.float64).reshape(len(u), width)

    def _place(self, c: int, estimator: OnlineEstimator) -> None:
        """Write where a channel's arrays are; holding them keeps them there."""
        self._arguments[c] = estimator.arguments
        self._table[c, :UNKNOWN_INPUT] = table_of(estimator.arguments)
        self._table[c, UNKNOWN_INPUT, 0] = estimator.observer.unknown_input_address
