# SPDX-License-Identifier: Apache-2.0
"""Recorded known inputs, held between their samples as the node holds them."""

from collections.abc import Callable, Mapping

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.inputs import Input
from fhaosmo_ros.tools.bags.reader import BagReader
import numpy as np
from numpy.typing import NDArray


class HeldInputs:
    """
    Callable that returns u at given times; the times of a call follow those of the call before.

    Parameters
    ----------
    reader : BagReader
    model : TriangularModel
        Says which known inputs there are, and which of them it uses; the others are 0.
    wanted : mapping of str to Input
        Where those that it uses are; full names of the topics.
    reject : callable
        Gets the number of values that were not finite, and were left out.

    Raises
    ------
    ConfigurationError
        The bag has no such topic or field, or another number of them is given.

    """

    def __init__(
        self,
        reader: BagReader,
        model: TriangularModel,
        wanted: Mapping[str, Input],
        reject: Callable[[int], None],
    ) -> None:
        used = model.used_inputs
        self._width = len(model.inputs)
        self._columns = [model.inputs.index(name) for name in used]
        self._held = [_HeldInput(reader, wanted[name], reject) for name in used]

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return u at each time (of the bag), (K, m): the last finite ones, or 0."""
        u = np.zeros((len(times), self._width))
        for column, held in zip(self._columns, self._held, strict=True):
            u[:, column] = held(times)
        return u


class _HeldInput:
    """One of them."""

    def __init__(self, reader: BagReader, wanted: Input, reject: Callable[[int], None]) -> None:
        field = reader.field(wanted.topic, wanted.field, wanted.name)
        self._blocks = reader.blocks(wanted.topic, field, every=False)
        self._reject = reject
        self._times = np.zeros(0, dtype=np.int64)
        self._values = np.zeros(0)
        self._held = 0.0

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
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
