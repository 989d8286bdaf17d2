# SPDX-License-Identifier: Apache-2.0
"""
Which topics and fields an estimator reads.

y is ``input_topic``, ``input_type``, ``input_field`` and ``input_stamp``; the known inputs are the
lists ``known_input_topics`` and so on.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
import warnings

from fhaosmo_ros.core.parameters.per_channel import channel_names, FROM_JOINTS
from fhaosmo_ros.core.parameters.tables import CHANNEL_PARAMETERS
from fhaosmo_ros.messages.fields import JOINT_STATE
from fhaosmo_ros.topics import FLOAT

PARTS = ('topic', 'type', 'field')


class Input(NamedTuple):
    """A number that an estimator reads."""

    topic: str  # as the user wrote it: below the node's namespace, unless it begins with /
    message_type: str  # '' if it is the one that the topic has
    field: str  # '' for the only number
    name: str  # of the channel: the element of a list that is meant where the field has no index
    stamp: str = 'reception'  # of y auto, header, source or reception

    def absolute(self, namespace: str) -> str:
        """Return the topic's full name in a namespace such as '/rig' ('' or '/' for none)."""
        if self.topic.startswith('/'):
            return self.topic
        return f'/{namespace.strip("/")}/{self.topic}'.replace('//', '/')


def with_joints(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values, with the topic and type that `FROM_JOINTS` stands for."""
    result = dict(values)
    if channel_names(values) == FROM_JOINTS:
        for name, value in (('input_topic', 'joint_states'), ('input_type', JOINT_STATE)):
            result[name] = result.get(name) or value
    return result


def measured_output(values: Mapping[str, Any], channel: str = '') -> Input:
    """Return what y is, by the complete parameters of a channel; its name is '' without names."""
    parts = [values[f'input_{part}'] for part in PARTS]
    return _input('y', *parts, channel)._replace(stamp=values['input_stamp'])


def known_inputs(
    values: Mapping[str, Any], names: Sequence[str], channel: str = ''
) -> dict[str, Input]:
    """
    Return what the known inputs are that the model uses, by their `names` in it; else as for y.

    Warns of what is said of known inputs of a model without any. Raises ConfigurationError for a
    list with neither one entry nor one for each of them.
    """
    columns = []
    for part in PARTS:
        declared = CHANNEL_PARAMETERS[f'known_input_{part}s']
        given: list[str] = values[declared.name]
        if not names and given != declared.default:
            where = f'channel {channel}: ' if channel else ''
            warnings.warn(
                f"{where}'{declared.name}' is not used: phi has no known input", stacklevel=2
            )
            continue
        if len(given) not in (1, len(names)):
            listed = ', '.join(names)
            raise declared.error(
                given, f'one for each known input that phi uses ({listed}), or one for all'
            )
        columns.append(given if len(given) == len(names) else given * len(names))
    return {
        name: _input(name, *parts, channel) for name, *parts in zip(names, *columns, strict=True)
    }


def _input(name: str, topic: str, message_type: str, field: str, channel: str) -> Input:
    """Return an input; one of which nothing is said is a Float64 on the topic of its name."""
    if not (topic or message_type or field):
        message_type = FLOAT
    below = f'{channel}/{name}' if channel else name
    return Input(topic or below, message_type, field, channel)
