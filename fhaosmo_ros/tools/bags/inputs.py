# SPDX-License-Identifier: Apache-2.0
"""Recorded samples of y, and the known inputs at them, as the node finds them."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from heapq import merge
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.inputs import Input, known_inputs, make_pairing, measured_output
from fhaosmo_ros.messages.fields import Field
from fhaosmo_ros.pairing import StampPairing
from fhaosmo_ros.tools.bags.reader import BagReader, FieldSamples, Watch
import numpy as np
from numpy.typing import NDArray

Arrival = tuple[int, int, int, float]
"""Time in the bag, number of the input or `SAMPLE`, stamp, and value."""
SAMPLE = 1000
"""A sample comes after the inputs that have its time."""


class BagInputs(NamedTuple):
    """
    Where y and u are in a bag.

    Attributes
    ----------
    y : Input
        With the full name of its topic, and its stamp as for `BagReader.samples`.
    u : mapping of str to Input
        The known inputs that the model uses, with full names.
    values : mapping
        Parameters of the channel.

    """

    y: Input
    u: Mapping[str, Input]
    values: Mapping[str, Any]


def bag_inputs(
    values: Mapping[str, Any],
    used: Sequence[str],
    present: Collection[str] = (),
    namespace: str = '',
    channel: str = '',
) -> BagInputs:
    """
    Return where y and u are by the parameters of an estimator.

    Parameters
    ----------
    values : mapping
        Parameters of the channel.
    used : sequence of str
        Known inputs that its model uses.
    present : collection of str
        Topics of the bag.
    namespace : str
        Of the node.
    channel : str
        Its name, '' without named channels.

    """

    def full(wanted: Input) -> Input:
        # A bag may hold the y of one channel, or of a node in another namespace, as /y.
        relative = wanted.topic.removeprefix(f'{channel}/')
        names = [wanted.absolute(namespace), wanted.absolute(''), f'/{relative.lstrip("/")}']
        return wanted._replace(topic=next((n for n in names if n in present), names[1]))

    y = full(measured_output(values, channel))
    u = {name: full(its) for name, its in known_inputs(values, used, channel).items()}
    return BagInputs(y._replace(stamp='bag') if y.stamp == 'reception' else y, u, values)


def read_output(
    reader: BagReader, inputs: BagInputs, watch: Watch = iter
) -> tuple[FieldSamples, Field]:
    """
    Return the samples of y, and the field that they were in.

    Parameters
    ----------
    reader : BagReader
    inputs : BagInputs
    watch : callable
        See `BagReader.samples`.

    Raises
    ------
    ConfigurationError
        The bag lacks the topic or the field, or has no samples.

    """
    y, stamp = inputs.y, inputs.y.stamp
    field = reader.field(y.topic, y.field, y.name)
    if stamp == 'auto' and not field.header and inputs.values.get('sampling') == 'clock':
        stamp = 'bag'  # such an estimator took a sample when it came, not when it was sent
    samples = reader.samples(y.topic, field, stamp, watch)
    if not len(samples.times):
        why = next(iter(reader.lacking), 'expected messages, read none')
        raise ConfigurationError(f'topic {y.topic!r}: {why}')
    return samples, field


def inputs_at(
    samples: FieldSamples,
    reader: BagReader,
    model: TriangularModel,
    inputs: BagInputs,
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
    inputs : BagInputs
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
    pairing = make_pairing(inputs.values, model.inputs, inputs.u, before) or StampPairing(
        [False] * count, 0, 0, before
    )
    arrivals = [_arrivals(samples, SAMPLE)]
    for name in model.used_inputs:
        its = inputs.u[name]
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
