# SPDX-License-Identifier: Apache-2.0
"""The parameters that an estimator published into a bag: those of the estimates in it."""

from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import loads
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.topics import PARAMETERS, TEXT


class Recorded(NamedTuple):
    """Parameters of a node, as its first message in the bag has them."""

    topic: str
    values: dict[str, Any]  # checked, in their own types; those of channels with channels' names
    channel: str  # the one that was asked for, '' if the node has no named channels

    @property
    def namespace(self) -> str:
        """Namespace of the node: '/rig' of /rig/estimator/parameters."""
        return self.topic.rsplit('/', 2)[0]


def recorded_parameters(reader: BagReader, name: str | None = None) -> Recorded | None:
    """
    Return an estimator's parameters at the begin of the bag, or None if the bag lacks them.

    Later live changes are not among them.

    Parameters
    ----------
    reader : BagReader
    name : str, optional
        Name of the estimator: its node's, followed by the channel's if it has channels. Default:
        the only node in the bag that has published its parameters, if it has no channels.

    Raises
    ------
    ConfigurationError
        They are not parameters of this version.

    """
    topics = {
        c.topic
        for c in reader.connections
        if c.topic.endswith(f'/{PARAMETERS}') and c.msgtype == TEXT and c.msgcount
    }
    if name is None:
        if len(topics) != 1:
            return None
        name = min(topics).removesuffix(f'/{PARAMETERS}')
    for node in (name, name.rpartition('/')[0]):
        topic = f'{node}/{PARAMETERS}'
        if topic in topics:
            _, _, message = reader.read_all({topic})[0]
            try:
                values = loads(message.data, node, ESTIMATOR_PARAMETERS)
            except ConfigurationError as error:
                raise ConfigurationError(
                    f'topic {topic!r}: {error}; --params-file does without it'
                ) from None
            return Recorded(topic, values, name.removeprefix(node).strip('/'))
    return None
