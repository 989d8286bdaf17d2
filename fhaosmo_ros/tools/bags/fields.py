# SPDX-License-Identifier: Apache-2.0
"""One number out of a message of any type, by the bag's own type definitions."""

from collections.abc import Iterator, Mapping
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""How rosbags numbers the kinds of a field."""
HEADER = 'std_msgs/msg/Header'
KINDS = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1', 'int8': 'i1', 'uint8': 'u1',
    'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8',
    'float32': 'f4', 'float64': 'f8',
}  # fmt: skip


class Field(NamedTuple):
    """
    A number in the messages of a topic.

    Attributes
    ----------
    text : str
        As the user wrote it, such as 'angular_velocity.z' or 'position[2]'.
    steps : list of str and int
        Names of fields and indices of lists, from the message inwards.
    kind : dtype
    has_header : bool
        True if the message begins with a std_msgs/Header.
    types : mapping
        Definitions by type, as a rosbags typestore's ``fielddefs``.
    message_type : str

    """

    text: str
    steps: list[str | int]
    kind: np.dtype
    has_header: bool
    types: Mapping[str, Any]
    message_type: str


def find_field(types: Mapping[str, Any], message_type: str, text: str | None) -> Field:
    """
    Find a field in a message type; without a text, take the type's only number or its `data`.

    Parameters
    ----------
    types : mapping
        Definitions by type, as a rosbags typestore's ``fielddefs``.
    message_type : str
        Such as 'sensor_msgs/msg/JointState'.
    text : str or None
        Names separated by dots; [index] follows the name of a list.

    Raises
    ------
    ConfigurationError
        There is no such field, or it holds no number; the message lists the fields that do.

    """
    if text is None:
        text = _only_number(types, message_type)
    steps = _steps(text)
    kind = _kind(types, message_type, steps) if steps is not None else None
    if steps is None or kind is None:
        known = list(_numbers(types, message_type))
        hint = suggestion(text, known)
        raise ConfigurationError(
            f'field {text!r}: expected a number in {message_type}, one of '
            f'{", ".join(known) or "none: it holds no number"}, got {text!r}{hint}'
        )
    fields = types[message_type][1]
    has_header = bool(fields) and fields[0][1] == (NAME, HEADER)
    return Field(text, steps, np.dtype(kind), has_header, types, message_type)


def _only_number(types: Mapping[str, Any], message_type: str) -> str:
    known = list(_numbers(types, message_type))
    if len(known) == 1 and '[' not in known[0]:
        return known[0]
    if 'data' in known:
        return 'data'
    raise ConfigurationError(
        f'--field is needed for {message_type}: expected one of '
        f'{", ".join(known) or "none: it holds no number"}, got nothing'
    )


def _numbers(types: Mapping[str, Any], message_type: str, prefix: str = '') -> Iterator[str]:
    """Yield the paths of all numbers of a type, lists with [i]."""
    for name, (node, detail) in types[message_type][1]:
        path = prefix + name
        if node in (ARRAY, SEQUENCE):
            node, detail = detail[0]
            path += '[i]'
        if node == NAME:
            if detail != HEADER:
                yield from _numbers(types, detail, f'{path}.')
        elif detail[0] in KINDS:
            yield path


def _steps(text: str) -> list[str | int] | None:
    if not re.fullmatch(r'[A-Za-z]\w*(\[\d+\])*(\.[A-Za-z]\w*(\[\d+\])*)*', text):
        return None
    return [int(w) if w.isdigit() else w for w in re.findall(r'\w+', text)]


def _kind(types: Mapping[str, Any], message_type: str, steps: list[str | int]) -> str | None:
    """Follow the steps; return the number's kind, or None if they lead to none."""
    node: Any = (NAME, message_type)
    for step in steps:
        if isinstance(step, str) and node[0] == NAME and node[1] in types:
            node = dict(types[node[1]][1]).get(step, (None, None))
        elif isinstance(step, int) and (
            node[0] == SEQUENCE or (node[0] == ARRAY and step < node[1][1])
        ):
            node = node[1][0]
        else:
            return None
    return KINDS.get(node[1][0]) if node[0] == BASE else None
