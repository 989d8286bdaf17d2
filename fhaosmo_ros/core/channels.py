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
    ) -> list[int]:
        words = []
        for c, stamp, value, known in zip(channel, stamps, y, u, strict=True):
            self._estimators[c]._u = known
            words.append(self._estimators[c].advance(stamp, value))
        return words
