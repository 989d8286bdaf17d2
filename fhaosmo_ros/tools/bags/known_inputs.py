# SPDX-License-Identifier: Apache-2.0
"""Recorded known inputs at the samples of y, as the node finds them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from heapq import merge
from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.inputs import Input, make_pairing
from fhaosmo_ros.pairing import StampPairing
from fhaosmo_ros.tools.bags.reader import BagReader, FieldSamples
import numpy as np
from numpy.typing import NDArray

Arrival = tuple[int, int, int, float]
"""Time in the bag, number of the input or `SAMPLE`, stamp, and value."""
SAMPLE = 1000
"""A sample comes after the inputs that have its time."""


def inputs_at(
    samples: FieldSamples,
    reader: BagReader,
    model: TriangularModel,
    wanted: Mapping[str, Input],
    values: Mapping[str, Any],
    held: Sequence[float] | None = None,
    reject: Callable[[int], None] = lambda _: None,
) -> NDArray[np.float64]:
    """
    Return the known inputs at samples of y, (K, m).

    Samples and inputs are taken in the order of the bag, as the node takes them in that of
    arrival.

    Parameters
    ----------
    samples : FieldSamples
    reader : BagReader
    model : TriangularModel
        Says which known inputs there are, and which of them it uses; the others are 0.
    wanted : mapping of str to Input
        Where those that it uses are; full names of the topics.
    values : mapping
        Parameters of the estimator.
    held : sequence of float, optional
        The known inputs before the first ones in the bag; else they are 0.
    reject : callable, optional
        Gets the number of values that were not finite, and were left out.

    Raises
    ------
    ConfigurationError
        The bag has no such topic or field.

    """
    count = len(model.inputs)
    before = list(held or [0.0] * count)
    # Without inputs by their headers' stamps, samples do not wait.
    pairing = make_pairing(values, model.inputs, wanted, before) or StampPairing(
        [False] * count, 0, 0, before
    )
    arrivals = [_arrivals(samples, SAMPLE)]
    for name in model.used_inputs:
        its = wanted[name]
        field = reader.field(its.topic, its.field, its.name)
        found = reader.samples(its.topic, field, 'header' if its.stamp == 'header' else 'bag')
        good = np.isfinite(found.values)
        reject(int((~good).sum()))
        arrivals.append(_arrivals(found.part(good), model.inputs.index(name)))

    def paired() -> Iterator[list[float]]:
        for _, j, stamp, u in merge(*arrivals):
            if j == SAMPLE:
                pairing.take_sample(stamp, None)
            else:
                pairing.take_input(j, stamp, u)
            yield from (row for _, row in pairing.released())
        yield from (row for _, row in pairing.released(at_once=True))

    return np.fromiter(paired(), np.dtype((np.float64, count)), len(samples.times))


def _arrivals(samples: FieldSamples, number: int) -> Iterator[Arrival]:
    for time, stamp, value in zip(*(column.tolist() for column in samples), strict=True):
        yield time, number, stamp, value
