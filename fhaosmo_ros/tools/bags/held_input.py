# SPDX-License-Identifier: Apache-2.0
"""Recorded known inputs, held between their samples as the node holds them."""

from collections.abc import Callable, Sequence

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
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
    topics, fields : sequence of str
        Of the inputs that the model uses, in their order: none (topic /NAME, the only number in
        its messages), one for all, or one for each; see `find_field`.
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
        topics: Sequence[str],
        fields: Sequence[str],
        reject: Callable[[int], None],
    ) -> None:
        used = model.used_inputs
        sources = zip(
            _one_each('--input-topic', topics, used) or [f'/{name}' for name in used],
            _one_each('--input-field', fields, used) or [None] * len(used),
            strict=True,
        )
        self._width = len(model.inputs)
        self._columns = [model.inputs.index(name) for name in used]
        self._held = [_HeldInput(reader, *source, reject) for source in sources]

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return u at each time (of the bag), (K, m): the last finite ones, or 0."""
        u = np.zeros((len(times), self._width))
        for column, held in zip(self._columns, self._held, strict=True):
            u[:, column] = held(times)
        return u


def _one_each(option: str, given: Sequence[str], names: Sequence[str]) -> list[str]:
    if len(given) > 1 and len(given) != len(names):
        raise ConfigurationError(
            f'{option}: expected one, or one for each known input that phi uses '
            f'({", ".join(names) or "none"}), got {len(given)}'
        )
    return list(given) * (len(names) if len(given) == 1 else 1)


class _HeldInput:
    """One of them."""

    def __init__(
        self, reader: BagReader, topic: str, field: str | None, reject: Callable[[int], None]
    ) -> None:
        self._blocks = reader.blocks(topic, reader.field(topic, field))
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
