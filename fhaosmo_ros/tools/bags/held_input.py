# SPDX-License-Identifier: Apache-2.0
"""A recorded known input u, held between its samples as the node holds it."""

from collections.abc import Callable

from fhaosmo_ros.tools.bags.reader import BagReader
import numpy as np
from numpy.typing import NDArray


class HeldInput:
    """
    Callable that returns u at given times; the times of a call follow those of the call before.

    Parameters
    ----------
    reader : BagReader
    topic : str
    field : str or None
        Number in its messages; see `find_field`.
    reject : callable
        Gets the number of values that were not finite, and were left out.

    Raises
    ------
    ConfigurationError
        The bag has no such topic or field.

    """

    def __init__(
        self, reader: BagReader, topic: str, field: str | None, reject: Callable[[int], None]
    ) -> None:
        self._blocks = reader.blocks(topic, reader.field(topic, field))
        self._reject = reject
        self._times = np.zeros(0, dtype=np.int64)
        self._values = np.zeros(0)
        self._held = 0.0

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return u at each time (of the bag): the last finite one that is not later, or 0."""
        while not len(self._times) or self._times[-1] <= times[-1]:
            block = next(self._blocks, None)
            if block is None:
                break
            good = np.isfinite(block.values)
            self._reject(int((~good).sum()))
            self._times = np.concatenate([self._times, block.times[good]])
            self._values = np.concatenate([self._values, block.values[good]])
        last = np.searchsorted(self._times, times, side='right')
        u = np.concatenate([[self._held], self._values])[last]
        self._held = float(u[-1])
        self._times, self._values = self._times[last[-1] :], self._values[last[-1] :]
        return u
