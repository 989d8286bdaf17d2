# SPDX-License-Identifier: Apache-2.0
"""Recorded samples of y, and the known inputs at them, as the node finds them."""

from collections.abc import Iterator, Mapping, Sequence
from heapq import merge
from typing import Any

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.inputs import Input, known_inputs, measured_output, Pairing
from fhaosmo_ros.messages.fields import Field
from fhaosmo_ros.tools.bags.reader import BagReader, Samples
import numpy as np
from numpy.typing import NDArray

SAMPLE = 1000
"""A sample comes after the inputs that have its time."""


class BagInputs:
    """
    Where a bag has y and the known inputs of an estimator, by its parameters.

    `values` are those of the channel, complete; `model` says which known inputs there are, and
    which of them it uses (the others are 0); `namespace` is that of the node, and `channel` the
    name of the channel, '' without named channels. `y` is where y is, with the full name of its
    topic.
    """

    def __init__(
        self,
        reader: BagReader,
        values: Mapping[str, Any],
        model: TriangularModel,
        namespace: str = '',
        channel: str = '',
    ) -> None:
        self._reader, self._values, self._model = reader, values, model
        present = {c.topic for c in reader.connections}

        def full(wanted: Input) -> Input:
            # A bag may hold the y of one channel, or of a node in another namespace, as /y.
            relative = wanted.topic.removeprefix(f'{channel}/')
            names = [wanted.absolute(namespace), wanted.absolute(''), f'/{relative.lstrip("/")}']
            return wanted._replace(topic=next((n for n in names if n in present), names[1]))

        known = known_inputs(values, model.used_inputs, channel)
        self._u = {name: full(its) for name, its in known.items()}
        self.y = full(measured_output(values, channel))

    def samples(self) -> tuple[Samples, Field]:
        """Return the samples of y, at least one, and the field that they were in."""
        y, stamp, reader = self.y, self.y.stamp, self._reader
        field = reader.field(y.topic, y.field, y.name)
        if stamp == 'auto' and not field.header and self._values['sampling'] == 'clock':
            stamp = 'reception'  # such an estimator took no sample before it came
        samples = reader.samples(y.topic, field, stamp)
        if not len(samples.times):
            why = next(iter(reader.lacking), 'expected messages, read none')
            raise ConfigurationError(f'topic {y.topic!r}: {why}')
        return samples, field

    def at(self, samples: Samples, held: Sequence[float] = ()) -> NDArray[np.float64]:
        """
        Return the known inputs at samples of y, (K, m).

        Samples and inputs are taken in the order of the bag, as the node takes them in that of
        arrival; values that are not finite are left out. `held` are the inputs before the first
        ones in the bag, else 0.
        """
        names = self._model.inputs
        pairing = Pairing(self._values, names, self._u, held or [0.0] * len(names))
        arrivals = [_arrivals(samples, SAMPLE)]
        for name, its in self._u.items():
            field = self._reader.field(its.topic, its.field, its.name)
            found = self._reader.samples(its.topic, field, its.stamp)
            good = found.part(np.isfinite(found.values))
            arrivals.append(_arrivals(good, names.index(name)))

        def paired() -> Iterator[list[float]]:
            for _, j, stamp, u in merge(*arrivals):
                if j == SAMPLE:
                    pairing.take_sample(stamp, None)
                else:
                    pairing.take_input(j, stamp, u)
                yield from (row for _, row in pairing.released())
            yield from (row for _, row in pairing.released(at_once=True))

        return np.fromiter(paired(), np.dtype((np.float64, len(names))), len(samples.times))


def _arrivals(samples: Samples, number: int) -> Iterator[tuple[int, int, int, float]]:
    """Yield time in the bag, number of the input or `SAMPLE`, stamp, and value."""
    for time, stamp, value in zip(*(column.tolist() for column in samples), strict=True):
        yield time, number, stamp, value
