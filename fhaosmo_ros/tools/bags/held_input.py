# SPDX-License-Identifier: Apache-2.0
"""Recorded known inputs at the samples of y, as the node finds them."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from heapq import merge
from itertools import chain
from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.inputs import Input, make_pairing
from fhaosmo_ros.tools.bags.reader import BagReader, Block
import numpy as np
from numpy.typing import NDArray


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
        used = model.used_inputs
        self._names, self._wanted, self._values = model.inputs, wanted, values
        self._columns = [model.inputs.index(name) for name in used]
        self._inputs = [_RecordedInput(reader, wanted[name], reject) for name in used]

    def along(
        self, blocks: Iterable[Block], held: Callable[[], Sequence[float]] | None = None
    ) -> Iterator[tuple[Block, NDArray[np.float64]]]:
        """
        Yield each block with the known inputs at its samples, (K, m).

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
        pairing = make_pairing(self._values, self._names, self._wanted, before)
        following = chain([first], blocks)
        if pairing is None:
            yield from ((block, self._held(block.times, before)) for block in following)
        else:
            yield from self._paired(following, pairing)

    def _held(self, times: NDArray[np.int64], before: list[float]) -> NDArray[np.float64]:
        """Return the last finite ones that the bag has at these times."""
        u = np.tile(before, (len(times), 1))
        for j, recorded in zip(self._columns, self._inputs, strict=True):
            u[:, j] = recorded.held(times, before[j])
            before[j] = u[-1, j]
        return u

    def _paired(
        self, blocks: Iterable[Block], pairing: Any
    ) -> Iterator[tuple[Block, NDArray[np.float64]]]:
        """Take samples and inputs in the order of the bag, as the node in that of arrival."""
        inputs = merge(*(r.events(j) for j, r in zip(self._columns, self._inputs, strict=True)))
        rows: list[list[float]] = []
        waiting: deque[Block] = deque()
        event = next(inputs, None)

        def complete() -> Iterator[tuple[Block, NDArray[np.float64]]]:
            while waiting and len(waiting[0].times) <= len(rows):
                block = waiting.popleft()
                count = len(block.times)
                yield block, np.array(rows[:count])
                del rows[:count]

        for block in blocks:
            waiting.append(block)
            for time, stamp in zip(block.times.tolist(), block.stamps.tolist(), strict=True):
                while event is not None and event[0] <= time:
                    pairing.take_input(*event[1:])
                    rows += [u for _, u in pairing.released()]
                    event = next(inputs, None)
                pairing.take_sample(stamp, None)
                rows += [u for _, u in pairing.released()]
            yield from complete()
        while event is not None and waiting:
            pairing.take_input(*event[1:])
            rows += [u for _, u in pairing.released()]
            event = next(inputs, None)
            yield from complete()
        rows += [u for _, u in pairing.released(at_once=True)]
        yield from complete()


class _RecordedInput:
    """One of them."""

    def __init__(self, reader: BagReader, wanted: Input, reject: Callable[[int], None]) -> None:
        field = reader.field(wanted.topic, wanted.field, wanted.name)
        stamp = 'header' if wanted.stamp == 'header' else 'bag'
        self._blocks = self._finite(reader.blocks(wanted.topic, field, stamp, every=False))
        self._reject = reject
        self._times = np.zeros(0, dtype=np.int64)
        self._values = np.zeros(0)

    def _finite(self, blocks: Iterator[Block]) -> Iterator[Block]:
        for block in blocks:
            good = np.isfinite(block.values)
            self._reject(int((~good).sum()))
            yield Block(*(column[good] for column in block))

    def events(self, j: int) -> Iterator[tuple[int, int, int, float]]:
        """Yield time in the bag, `j`, stamp and value of each."""
        for block in self._blocks:
            for time, stamp, value in zip(*(column.tolist() for column in block), strict=True):
                yield time, j, stamp, value

    def held(self, times: NDArray[np.int64], before: float) -> NDArray[np.float64]:
        """Return the last one at each time; times follow those of the call before."""
        while not len(self._times) or self._times[-1] <= times[-1]:
            block = next(self._blocks, None)
            if block is None:
                break
            self._times = np.concatenate([self._times, block.times])
            self._values = np.concatenate([self._values, block.values])
        last = np.searchsorted(self._times, times, side='right')
        u = np.concatenate([[before], self._values])[last]
        self._times, self._values = self._times[last[-1] :], self._values[last[-1] :]
        return u
