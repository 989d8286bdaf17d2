# SPDX-License-Identifier: Apache-2.0
"""Recorded known inputs at the samples of y, as the node finds them."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from heapq import merge
from itertools import chain
from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.inputs import Input, make_pairing
from fhaosmo_ros.pairing import StampPairing
from fhaosmo_ros.tools.bags.reader import BagReader, Block
import numpy as np
from numpy.typing import NDArray

WithInputs = tuple[Block, NDArray[np.float64]]
"""A block of y, and the known inputs at its samples, (K, m)."""


class HeldInputs:
    """
    The known inputs of the samples in blocks of y.

    Parameters
    ----------
    reader : BagReader
    model : TriangularModel
        Says which known inputs there are, and which of them it uses; the others are 0.
    wanted : mapping of str to Input
        Where those that it uses are; full names of the topics.
    values : mapping
        Parameters of the estimator.
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
        values: Mapping[str, Any],
        reject: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._names, self._wanted, self._values = model.inputs, wanted, values
        self._reject = reject
        self._inputs = []
        for name in model.used_inputs:
            topic, _, text, stamp, channel = wanted[name]
            field = reader.field(topic, text, channel)
            blocks = reader.blocks(topic, field, 'header' if stamp == 'header' else 'bag')
            self._inputs.append(self._finite(self._names.index(name), blocks))

    def _finite(self, j: int, blocks: Iterator[Block]) -> Iterator[tuple[int, int, int, float]]:
        """Yield time in the bag, number of the input, stamp and value of each of its messages."""
        for block in blocks:
            good = np.isfinite(block.values)
            self._reject(int((~good).sum()))
            for time, stamp, u in zip(*(part[good].tolist() for part in block), strict=True):
                yield time, j, stamp, u

    def along(
        self, blocks: Iterable[Block], held: Callable[[], Sequence[float]] | None = None
    ) -> Iterator[WithInputs]:
        """
        Yield each block with the known inputs at its samples.

        Samples and inputs are taken in the order of the bag, as the node takes them in that of
        arrival.

        Parameters
        ----------
        blocks : iterable of Block
        held : callable, optional
            Returns the known inputs before the first ones in the bag, once the first block is
            there; else they are 0.

        """
        blocks = iter(blocks)
        first = next(blocks, None)
        if first is None:
            return
        before = list(held()) if held else [0.0] * len(self._names)
        # Without inputs by their headers' stamps, samples do not wait.
        pairing = make_pairing(self._values, self._names, self._wanted, before) or StampPairing(
            [False] * len(before), 0, 0, before
        )
        inputs = merge(*self._inputs)
        event = next(inputs, None)
        rows: list[list[float]] = []
        waiting: deque[Block] = deque()
        for block in chain([first], blocks):
            waiting.append(block)
            for time, stamp in zip(block.times.tolist(), block.stamps.tolist(), strict=True):
                while event is not None and event[0] <= time:
                    pairing.take_input(*event[1:])
                    rows += [u for _, u in pairing.released()]
                    event = next(inputs, None)
                pairing.take_sample(stamp, None)
                rows += [u for _, u in pairing.released()]
            yield from _complete(waiting, rows)
        for later in chain([event] if event else [], inputs):
            pairing.take_input(*later[1:])
            rows += [u for _, u in pairing.released()]
            yield from _complete(waiting, rows)
            if not waiting:
                return
        rows += [u for _, u in pairing.released(at_once=True)]
        yield from _complete(waiting, rows)


def _complete(waiting: deque[Block], rows: list[list[float]]) -> Iterator[WithInputs]:
    """Yield the blocks whose samples all have their inputs, and forget them."""
    while waiting and len(waiting[0].times) <= len(rows):
        block = waiting.popleft()
        count = len(block.times)
        yield block, np.array(rows[:count])
        del rows[:count]
