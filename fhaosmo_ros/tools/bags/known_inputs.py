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

Rejects = Callable[[int], None]
"""Gets the number of values that were not finite, and were left out."""


def with_inputs(
    blocks: Iterable[Block],
    reader: BagReader,
    model: TriangularModel,
    wanted: Mapping[str, Input],
    values: Mapping[str, Any],
    held: Callable[[], Sequence[float]] | None = None,
    reject: Rejects = lambda _: None,
) -> Iterator[tuple[Block, NDArray[np.float64]]]:
    """
    Yield each block of y with the known inputs at its samples, (K, m).

    Samples and inputs are taken in the order of the bag, as the node takes them in that of
    arrival.

    Parameters
    ----------
    blocks : iterable of Block
    reader : BagReader
    model : TriangularModel
        Says which known inputs there are, and which of them it uses; the others are 0.
    wanted : mapping of str to Input
        Where those that it uses are; full names of the topics.
    values : mapping
        Parameters of the estimator.
    held : callable, optional
        Returns the known inputs before the first ones in the bag, once the first block is there;
        else they are 0.
    reject : callable, optional
        See `Rejects`.

    Raises
    ------
    ConfigurationError
        The bag has no such topic or field.

    """
    inputs = merge(
        *(
            _finite(reader, model.inputs.index(name), wanted[name], reject)
            for name in model.used_inputs
        )
    )
    blocks = iter(blocks)
    first = next(blocks, None)
    if first is None:
        return
    before = list(held()) if held else [0.0] * len(model.inputs)
    # Without inputs by their headers' stamps, samples do not wait.
    pairing = make_pairing(values, model.inputs, wanted, before) or StampPairing(
        [False] * len(before), 0, 0, before
    )
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


def _finite(
    reader: BagReader, j: int, wanted: Input, reject: Rejects
) -> Iterator[tuple[int, int, int, float]]:
    """Yield time in the bag, number of the input, stamp and value of each of its messages."""
    field = reader.field(wanted.topic, wanted.field, wanted.name)
    stamp = 'header' if wanted.stamp == 'header' else 'bag'
    for block in reader.blocks(wanted.topic, field, stamp):
        good = np.isfinite(block.values)
        reject(int((~good).sum()))
        for time, stamp, u in zip(*(part[good].tolist() for part in block), strict=True):
            yield time, j, stamp, u


def _complete(
    waiting: deque[Block], rows: list[list[float]]
) -> Iterator[tuple[Block, NDArray[np.float64]]]:
    """Yield the blocks whose samples all have their inputs, and forget them."""
    while waiting and len(waiting[0].times) <= len(rows):
        block = waiting.popleft()
        count = len(block.times)
        yield block, np.array(rows[:count])
        del rows[:count]
