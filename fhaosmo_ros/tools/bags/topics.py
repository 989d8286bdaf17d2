# SPDX-License-Identifier: Apache-2.0
"""
What nodes published into a bag: arrays, messages that belong together, and parameters.

Messages of two topics are never paired by counting: a recording may lack some of them, most often
at its begin and at its end. What was published together is found by its stamps in the bag.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import loads
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.topics import PARAMETERS, TEXT
import numpy as np
from numpy.typing import NDArray


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
