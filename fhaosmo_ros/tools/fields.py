# SPDX-License-Identifier: Apache-2.0
"""One number out of a message of any type, by the bag's own type definitions."""

from collections.abc import Iterator, Mapping
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import suggestion
import numpy as np

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""How rosbags numbers the kinds of a field."""
HEADER = 'std_msgs/msg/Header'
KINDS = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1', 'int8': 'i1', 'uint8': 'u1',
    'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8',
    'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
CDR_HEADER = 4
"""Bytes before a message's first field."""


class Field(NamedTuple):
    """
    Where a number lies in the messages of a topic.

    Attributes
    ----------
    text : str
        As written by the user, such as 'angular_velocity.z' or 'position[2]'.
    steps : list of str and int
        Names of fields and indices of lists, from the message inwards.
    kind : dtype
    offset : int or None
        Distance from the message's first byte in CDR, where it is the same in every message.
    has_header : bool
        True if the message begins with a std_msgs/Header.

    """

    text: str
    steps: list[str | int]
    kind: np.dtype
    offset: int | None
    has_header: bool

    def get(self, message: Any) -> float:
        """
        Return the number in a message.

        Raises
        ------
        ConfigurationError
            A list in this message is too short.

        """
        for step in self.steps:
            if isinstance(step, str):
                message = getattr(message, step)
            elif step < len(message):
                message = message[step]
            else:
                raise ConfigurationError(
                    f'field {self.text!r}: expected an index below the number of elements, '
                    f'{len(message)} in one message, got {step}'
                )
        return float(message)


def find_field(types: Mapping[str, Any], message_type: str, text: str | None) -> Field:
    """
    Find a field in a message type; without a text, the type's only number or its `data`.

    Parameters
    ----------
    types : mapping
        Definitions by type, as a rosbags typestore's ``fielddefs``.
    message_type : str
        Such as 'sensor_msgs/msg/JointState'.
    text : str or None
        Names divided by dots, with [index] behind a list.

    Raises
    ------
    ConfigurationError
        No such field, or it holds no number; lists the fields that do.

    """
    if text is None:
        text = _only_number(types, message_type)
    steps = _steps(text)
    kind, offset, missing = None, CDR_HEADER, steps is None
    if steps is not None:
        kind, offset = _walk(types, message_type, steps)
        missing = kind is None
    if missing or steps is None or kind is None:
        known = list(_numbers(types, message_type))
        hint = suggestion(text, known)
        raise ConfigurationError(
            f'field {text!r}: expected a number in {message_type}, one of '
            f'{", ".join(known) or "none: it holds no number"}, got {text!r}{hint}'
        )
    fields = types[message_type][1]
    has_header = bool(fields) and fields[0][1] == (NAME, HEADER)
    return Field(text, steps, np.dtype(kind), offset, has_header)


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


def _walk(
    types: Mapping[str, Any], message_type: str, steps: list[str | int]
) -> tuple[str | None, int | None]:
    """Follow the steps; return the number's kind (None: no such field) and its offset."""
    node: Any = (NAME, message_type)
    position: int | None = 0
    for step in steps:
        if isinstance(step, str) and node[0] == NAME and node[1] in types:
            for name, inner in types[node[1]][1]:
                if name == step:
                    node = inner
                    break
                position = _skip(types, inner, position)
            else:
                return None, None
        elif isinstance(step, int) and node[0] == ARRAY and step < node[1][1]:
            for _ in range(step):
                position = _skip(types, node[1][0], position)
            node = node[1][0]
        elif isinstance(step, int) and node[0] == SEQUENCE:
            node, position = node[1][0], None
        else:
            return None, None
    if node[0] != BASE or node[1][0] not in KINDS:
        return None, None
    kind = KINDS[node[1][0]]
    if position is None:
        return kind, None
    return kind, CDR_HEADER + _aligned(position, np.dtype(kind).itemsize)


def _aligned(position: int, size: int) -> int:
    return (position + size - 1) // size * size


def _skip(types: Mapping[str, Any], node: Any, position: int | None) -> int | None:
    """Return the position after a field, None if it depends on the message."""
    kind, detail = node
    if position is None or kind == SEQUENCE:
        return None
    if kind == BASE:
        if detail[0] not in KINDS:
            return None
        size = np.dtype(KINDS[detail[0]]).itemsize
        return _aligned(position, size) + size
    if kind == ARRAY:
        for _ in range(detail[1]):
            position = _skip(types, detail[0], position)
        return position
    for _, inner in types[detail][1]:
        position = _skip(types, inner, position)
    return position
