# SPDX-License-Identifier: Apache-2.0
"""Many estimators stepped in one call, each through the policy of a single one."""

from collections.abc import Sequence

from fhaosmo_ros.core.online.estimator import OnlineEstimator
import numpy as np
from numpy.typing import NDArray


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
        words = np.empty(len(channel), dtype=np.int64)
        unknown_inputs = np.empty(len(channel))
        inputs = [np.empty(len(e.inputs)) for e in self._estimators]
        for k, (c, stamp, value, its) in enumerate(zip(channel, stamps, y, u, strict=True)):
            estimator = self._estimators[c]
            inputs[c][:] = its
            words[k] = estimator.advance_with(stamp, value, inputs[c])
            unknown_inputs[k] = estimator.observer.structure.d
        return words, unknown_inputs
