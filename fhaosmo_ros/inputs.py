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
    """
    A number that an estimator reads.

    Attributes
    ----------
    topic : str
        As the user wrote it: relative to the node's namespace, unless it begins with /.
    message_type : str
        '' if it is the one that the topic has.
    field : str
        '' for the only number.
    stamp : str
        auto, header, source or reception; of a known input header or reception.
    name : str
        Of the channel: the element of a list that is meant where the field has no index.

    """

    topic: str
    message_type: str
    field: str
    stamp: str
    name: str

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
    get = _values(values)
    topic, kind, field = get('input_topic'), get('input_type'), get('input_field')
    stamp = get('input_stamp')
    if stamp == 'auto' and 'header' in get('known_input_stamps'):
        stamp = 'header'
    if not (topic or kind or field):
        kind = FLOAT
    return Input(topic or _below(channel, 'y'), kind, field, stamp, channel)


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
    get = _values(values)
    stamps = CHANNEL_PARAMETERS['known_input_stamps']
    if 'header' in get(stamps.name) and get('input_stamp') not in ('auto', 'header'):
        raise stamps.error(
            get(stamps.name), f'reception where input_stamp is {get("input_stamp")}'
        )
    columns = []
    for part in ('topics', 'types', 'fields', 'stamps'):
        declared = CHANNEL_PARAMETERS[f'known_input_{part}']
        columns.append(_one_each(declared, get(declared.name), names))
    found = {}
    for name, topic, kind, field, stamp in zip(names, *columns, strict=True):
        if not (topic or kind or field):
            kind = FLOAT
        found[name] = Input(topic or _below(channel, name), kind, field, stamp, channel)
    return found


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
    get = _values(values)
    wait, max_gap = round(get('known_input_wait') * 1e9), round((get('max_gap') or BACK) * 1e9)
    return StampPairing(by_stamp, wait, max_gap, held)


def _values(values: Mapping[str, Any]) -> Any:
    return lambda name: values.get(name, CHANNEL_PARAMETERS[name].default)


def _one_each(declared: Parameter, given: list[str], names: Sequence[str]) -> list[str]:
    if len(given) == 1:
        return given * len(names)
    if len(given) != len(names):
        raise declared.error(
            given, f'one for each known input that phi uses ({", ".join(names)}), or one for all'
        )
    return given


def _below(channel: str, name: str) -> str:
    return f'{channel}/{name}' if channel else name
