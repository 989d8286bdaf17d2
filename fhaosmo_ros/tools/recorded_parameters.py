# SPDX-License-Identifier: Apache-2.0
"""The parameters that an estimator published into a bag: what made the estimates in it."""

from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter_file import loads
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.bag_reader import BagReader

TOPIC, TYPE = 'parameters', 'std_msgs/msg/String'


class Recorded(NamedTuple):
    """
    Parameters of a node as a bag has them first.

    Attributes
    ----------
    topic : str
    values : dict
        Checked, in their own types; those of channels with the channels' names.
    channel : str
        The channel that was asked for, '' if the node has but one without a name.

    """

    topic: str
    values: dict[str, Any]
    channel: str


def recorded_parameters(reader: BagReader, name: str | None = None) -> Recorded | None:
    """
    Return what an estimator was set to when the bag begins, or None if the bag does not know.

    Later live changes are not in it.

    Parameters
    ----------
    reader : BagReader
    name : str, optional
        The estimator's: that of its node, and of the channel if it has many. Default: the only
        node in the bag that has published its parameters, if it has no channels.

    Raises
    ------
    ConfigurationError
        They are no parameters of this version.

    """
    topics = {
        c.topic for c in reader.connections
        if c.topic.endswith(f'/{TOPIC}') and c.msgtype == TYPE and c.msgcount
    }  # fmt: skip
    if name is None:
        if len(topics) != 1:
            return None
        name = min(topics).removesuffix(f'/{TOPIC}')
    for node in (name, name.rpartition('/')[0]):
        topic = f'{node}/{TOPIC}'
        if topic in topics:
            _, _, message = reader.few({topic})[0]
            try:
                values = loads(message.data, node, ESTIMATOR_PARAMETERS)
            except ConfigurationError as error:
                raise ConfigurationError(
                    f'topic {topic!r}: {error}; --params-file does without it'
                ) from None
            return Recorded(topic, values, name.removeprefix(node).strip('/'))
    return None
