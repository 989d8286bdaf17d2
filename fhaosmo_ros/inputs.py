# SPDX-License-Identifier: Apache-2.0
"""
Which topics and fields an estimator reads, from its parameters: for the node, and for tools.

y is ``input_topic``, ``input_type``, ``input_field`` and ``input_stamp``; the known inputs are the
lists ``known_input_topics`` and so on.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import Parameter
from fhaosmo_ros.core.parameters.per_channel import CHANNELS, FROM_JOINTS
from fhaosmo_ros.core.parameters.tables import CHANNEL_PARAMETERS
from fhaosmo_ros.messages.fields import JOINT_STATE
from fhaosmo_ros.pairing import StampPairing
from fhaosmo_ros.topics import FLOAT

BACK = 0.5
"""Seconds by which stamps of a known input go back if its clock does, where max_gap is 0."""


class Input(NamedTuple):
    """A number that an estimator reads."""

    topic: str  # as the user wrote it: below the node's namespace, unless it begins with /
    message_type: str  # '' if it is the one that the topic has
    field: str  # '' for the only number
    stamp: str  # auto, header, source or reception; of a known input header or reception
    name: str  # of the channel: the element of a list that is meant where the field has no index

    def absolute(self, namespace: str) -> str:
        """Return the topic's full name in a namespace such as '/rig' ('' or '/' for none)."""
        if self.topic.startswith('/'):
            return self.topic
        return f'/{namespace.strip("/")}/{self.topic}'.replace('//', '/')


def with_joints(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values to which the topic and type are added that `FROM_JOINTS` stands for."""
    result = dict(values)
    names = values.get(CHANNELS)  # not checked yet
    if ([names] if isinstance(names, str) else names) == FROM_JOINTS:
        for name, value in (('input_topic', 'joint_states'), ('input_type', JOINT_STATE)):
            result[name] = result.get(name) or value
    return result


def measured_output(values: Mapping[str, Any], channel: str = '') -> Input:
    """
    Return what y is.

    Parameters
    ----------
    values : mapping
        Parameters of the channel; defaults for those that are absent.
    channel : str
        Its name, '' without named channels.

    """
    topic, kind, field, stamp = (
        _value(values, f'input_{part}') for part in ('topic', 'type', 'field', 'stamp')
    )
    if stamp == 'auto' and 'header' in _value(values, 'known_input_stamps'):
        stamp = 'header'
    return _input('y', topic, kind, field, stamp, channel)


def known_inputs(
    values: Mapping[str, Any], names: Sequence[str], channel: str = ''
) -> dict[str, Input]:
    """
    Return what the known inputs are, by their names in the model.

    Parameters
    ----------
    values, channel
        As for `measured_output`.
    names : sequence of str
        Of the known inputs that the model uses, such as ``['u']``.

    Raises
    ------
    ConfigurationError
        A list with neither one entry nor one for each known input, or inputs by their header's
        stamp where y is not.

    """
    stamps, by = CHANNEL_PARAMETERS['known_input_stamps'], _value(values, 'input_stamp')
    given = _value(values, stamps.name)
    if 'header' in given and by not in ('auto', 'header'):
        raise stamps.error(given, f'reception where input_stamp is {by}')
    columns = [
        _one_each(CHANNEL_PARAMETERS[f'known_input_{part}'], values, names)
        for part in ('topics', 'types', 'fields', 'stamps')
    ]
    return {
        name: _input(name, *parts, channel) for name, *parts in zip(names, *columns, strict=True)
    }


def make_pairing(
    values: Mapping[str, Any],
    names: Sequence[str],
    known: Mapping[str, Input],
    held: Sequence[float],
) -> StampPairing | None:
    """
    Return what pairs known inputs with samples by their headers' stamps; None without such inputs.

    Parameters
    ----------
    values : mapping
        Parameters of the channel.
    names : sequence of str
        All known inputs of the model.
    known : mapping of str to Input
        Those that it uses.
    held : sequence of float
        What they are before the first ones come.

    """
    by_stamp = [name in known and known[name].stamp == 'header' for name in names]
    if not any(by_stamp):
        return None
    wait = round(_value(values, 'known_input_wait') * 1e9)
    max_gap = round((_value(values, 'max_gap') or BACK) * 1e9)
    return StampPairing(by_stamp, wait, max_gap, held)


def _value(values: Mapping[str, Any], name: str) -> Any:
    return values.get(name, CHANNEL_PARAMETERS[name].default)


def _one_each(declared: Parameter, values: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    given: list[str] = _value(values, declared.name)
    if len(given) == 1:
        return given * len(names)
    if len(given) != len(names):
        raise declared.error(
            given, f'one for each known input that phi uses ({", ".join(names)}), or one for all'
        )
    return given


def _input(
    name: str, topic: str, message_type: str, field: str, stamp: str, channel: str
) -> Input:
    """Return an input; one of which nothing is said is a Float64 on the topic of its name."""
    if not (topic or message_type or field):
        message_type = FLOAT
    below = f'{channel}/{name}' if channel else name
    return Input(topic or below, message_type, field, stamp, channel)
