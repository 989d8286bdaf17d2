# SPDX-License-Identifier: Apache-2.0
"""
What a bag has of an estimator: samples of y, known inputs at them, its estimates and parameters.

Messages of two topics are never paired by counting: a recording may lack some of them, most often
at its begin and at its end. What was published together is found by its stamps in the bag.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
import warnings

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import loads
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.inputs import Input, known_inputs, measured_output
from fhaosmo_ros.messages.fields import Field
from fhaosmo_ros.tools.bags.reader import BagReader, Samples
from fhaosmo_ros.topics import PARAMETERS, TEXT
import numpy as np
from numpy.typing import NDArray


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

        Each is the latest finite one that has come by the time of the sample in the bag, as the
        node takes the latest one that has arrived. `held` are the inputs before the first ones in
        the bag, else 0; of an input that nobody published, all the time, as in the node.
        """
        names = self._model.inputs
        u = np.tile(held or [0.0] * len(names), (len(samples.times), 1))
        for name, its in self._u.items():
            column = u[:, names.index(name)]
            if not self._reader.count(its.topic):
                warnings.warn(
                    f'the bag has no messages on {its.topic}: {name} is held at {column[0]:g}',
                    stacklevel=2,
                )
                continue
            field = self._reader.field(its.topic, its.field, its.name)
            found = self._reader.samples(its.topic, field)
            found = found.part(np.isfinite(found.values))
            known = np.append(column[0], found.values)
            column[:] = known[np.searchsorted(found.times, samples.times, side='right')]
        return u


def read_ticks(reader: BagReader, name: str, parts: Sequence[str]) -> dict[str, NDArray[Any]]:
    """
    Return the values of an estimator's topics, a row for each tick that all of them have.

    A tick is what the estimator publishes for one sample: a message on each of the topics `parts`
    below its name, of which the last one is published last.
    """
    found = {part: reader.samples(f'{name}/{part}') for part in parts}
    ticks = found[parts[-1]].times
    rows = {part: _rows_of_ticks(topic.times, ticks) for part, topic in found.items()}
    whole = np.all([row >= 0 for row in rows.values()], axis=0)
    return {part: topic.values[rows[part][whole]] for part, topic in found.items()}


def _rows_of_ticks(times: NDArray[np.int64], ticks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return which message of a topic belongs to each tick, -1 where it is missing."""
    first, last = np.iinfo(np.int64).min, np.iinfo(np.int64).max
    around = np.concatenate([[first], times, [last]])
    before = np.searchsorted(times, ticks, side='right')  # of each tick, in `around`
    after = before + 1
    early = around[before] > np.concatenate([[first], ticks[:-1]])
    late = around[after] < np.concatenate([ticks[1:], [last]])
    # The estimator publishes it before the last topic; but a recorder that stamps messages as
    # they arrive may have taken it after. The topic's own pauses tell which of the two.
    lead = np.median((ticks - around[before])[early]) if early.any() else np.inf
    lag = np.median((around[after] - ticks)[late]) if late.any() else np.inf
    return (np.where(early, before, 0) if lead <= lag else np.where(late, after, 0)) - 1


class Recorded(NamedTuple):
    """Parameters of a node, as its first message in the bag has them."""

    topic: str
    values: dict[str, Any]  # checked, in their own types; those of channels with channels' names
    channel: str  # the one that was asked for, '' if the node has no named channels


def recorded_parameters(reader: BagReader, name: str | None = None) -> Recorded | None:
    """
    Return an estimator's parameters at the begin of the bag, or None if the bag lacks them.

    `name` is that of its node, followed by the channel's if it has channels; by default that of
    the only node in the bag that has published its parameters, if it has no channels. Later live
    changes are not among them. ConfigurationError if they are not parameters of this version.
    """
    nodes = [
        node for node in reader.names_above(PARAMETERS)
        if reader.message_type(f'{node}/{PARAMETERS}') == TEXT
    ]  # fmt: skip
    name = name or (nodes[0] if len(nodes) == 1 else '')
    for node in (name, name.rpartition('/')[0]):
        topic = f'{node}/{PARAMETERS}'
        if node in nodes:
            _, _, message = reader.read_all({topic})[0]
            try:
                values = loads(message.data, node, ESTIMATOR_PARAMETERS)
            except ConfigurationError as error:
                raise ConfigurationError(
                    f'topic {topic!r}: {error}; --params-file does without it'
                ) from None
            return Recorded(topic, values, name.removeprefix(node).strip('/'))
    return None
