# SPDX-License-Identifier: Apache-2.0
"""Many estimators stepped together."""

from collections.abc import Sequence

from fhaosmo_ros.core.online import OnlineEstimator


class Channels:
    """
    Estimators that take their samples in one call.

    Parameters
    ----------
    estimators : sequence of OnlineEstimator

    """

    def __init__(self, estimators: Sequence[OnlineEstimator]) -> None:
        self._estimators = list(estimators)

    def advance(
        self, channel: Sequence[int], stamps: Sequence[int], y: Sequence[float], u: Sequence[float]
    ) -> tuple[list[int], list[float]]:
        """Take samples in order; return the status word, and the estimate of d, after each."""
        words, unknown_inputs = [], []
        for c, stamp, value, known in zip(channel, stamps, y, u, strict=True):
            estimator = self._estimators[c]
            estimator.set_input(known)
            words.append(estimator.advance(stamp, value))
            unknown_inputs.append(estimator.observer.unknown_input)
        return words, unknown_inputs
