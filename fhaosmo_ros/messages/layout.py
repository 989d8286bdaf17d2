# SPDX-License-Identifier: Apache-2.0
"""
Where a number lies in a message in CDR.

That depends on the lengths of the strings and lists before it, and on the order of the names if
the number is meant by name. These are mostly the same in message after message: so one message is
parsed, and others are compared with it in the few places where these lengths and names stand.
"""

import struct
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.messages.fields import (
    ARRAY,
    BASE,
    Field,
    Key,
    KINDS,
    MissingElementError,
    NAME,
    SEQUENCE,
)
import numpy as np

HEADER = 4
"""Bytes before a message's first field; the second of them says the byte order."""
SHORTER = 'a message is shorter than its type'


class Layout(NamedTuple):
    """
    Offset of a number in all messages that have the same bytes in the same places.

    Attributes
    ----------
    offset : int
        Distance of the number from the message's first byte; -1 if the message lacks it.
    same : list of (int, bytes)
        Offset and content of the message's first four bytes, of each length before the number,
        and of each name where it is meant by name. At least four bytes each.
    order : str
        '<' or '>'.
    missing : str
        Why the message lacks the number, '' if it has it.

    """

    offset: int
    same: list[tuple[int, bytes]]
    order: str
    missing: str = ''


def locate(field: Field, data: bytes) -> Layout:
    """
    Find a field in a message.

    Raises
    ------
    ValueError
        The message is shorter than its type.

    """
    if len(data) < HEADER:
        raise ValueError(SHORTER)
    walk = _Walk(field, data)
    offset, missing = -1, ''
    try:
        offset = walk.to_number()
    except MissingElementError as error:
        missing = str(error)
    except (struct.error, IndexError, UnicodeDecodeError):
        offset = len(data)
    if offset + field.width * field.kind.itemsize > len(data):
        raise ValueError(SHORTER)
    same = [(0, data[:HEADER]), *sorted(walk.same.items())]
    return Layout(offset, same, walk.order, missing)


class _Walk:
    """Parses a message as far as the field; positions count from behind its first four bytes."""

    def __init__(self, field: Field, data: bytes) -> None:
        self._field, self._data = field, data
        self.order = '<' if data[1] & 1 else '>'
        self.same: dict[int, bytes] = {}

    def to_number(self) -> int:
        node: Any = (NAME, self._field.message_type)
        position, at = 0, 0
        for step in self._field.steps:
            if isinstance(step, str):
                at = position  # where the fields among which it stands begin
                message = node[1]
                node, position = self.to(message, step, position)
                continue
            index = step if isinstance(step, int) else self._index(step, message, at)
            count = node[1][1]
            if node[0] == SEQUENCE:
                count, position = self._length(position)
            if index >= count:
                problem = (
                    'expected an index below the number of elements, '
                    f'{count} in one message, got {index}'
                )
                if isinstance(step, Key):  # the same text wherever the name stands
                    problem = f'expected an element for each name, got none for {step.name!r}'
                raise MissingElementError(f'field {self._field.text!r}: {problem}')
            node = node[1][0]
            position = self._past_many(node, index, position)
        return HEADER + _aligned(position, self._field.kind.itemsize)

    def to(self, message: str, name: str, position: int) -> tuple[Any, int]:
        """Return the definition and the position of a field of the message at `position`."""
        for other, inner in self._field.types[message][1]:
            if other == name:
                return inner, position
            position = self._past(inner, position)
        raise AssertionError(name)

    def _index(self, key: Key, message: str, position: int) -> int:
        """Return where a name stands in the list of names of the message at `position`."""
        names = self.names(*self.to(message, key.names, position))
        if key.name not in names:
            raise MissingElementError(
                f'field {self._field.text!r}: expected a name that is in the message '
                f'({", ".join(names) or "which has none"}), got {key.name!r}'
                f'{suggestion(key.name, names)}'
            )
        return names.index(key.name)

    def names(self, node: Any, position: int) -> list[str]:
        """Return the strings of a list of them, and remember them as `same`."""
        count = node[1][1]
        if node[0] == SEQUENCE:
            count, position = self._length(position)
        found = []
        for _ in range(count):
            length, begin = self._length(position)
            position = begin + length
            text = self._data[HEADER + begin : HEADER + position]
            if len(text) < length:
                raise IndexError
            at = HEADER + begin - 4
            self.same[at] = self.same[at][:4] + text
            found.append(text.rstrip(b'\0').decode())
        return found

    def _length(self, position: int) -> tuple[int, int]:
        at = HEADER + _aligned(position, 4)
        word = self._data[at : at + 4]
        count: int = struct.unpack(f'{self.order}I', word)[0]
        self.same.setdefault(at, word)
        return count, at - HEADER + 4

    def _past(self, node: Any, position: int) -> int:
        kind, detail = node
        if kind == NAME:
            for _, inner in self._field.types[detail][1]:
                position = self._past(inner, position)
            return position
        if kind == ARRAY:
            return self._past_many(detail[0], detail[1], position)
        if kind == SEQUENCE:
            count, position = self._length(position)
            return self._past_many(detail[0], count, position)
        if detail[0] in KINDS:
            return self._past_many(node, 1, position)
        if detail[0] != 'string':
            raise ValueError(f'fields behind one of type {detail[0]} can not be read')
        count, position = self._length(position)
        return position + count

    def _past_many(self, node: Any, count: int, position: int) -> int:
        if node[0] == BASE and node[1][0] in KINDS:
            size = np.dtype(KINDS[node[1][0]]).itemsize
            return _aligned(position, size) + count * size if count else position
        for _ in range(count):
            if position > len(self._data):
                break  # the bytes were not a length: the message is damaged
            position = self._past(node, position)
        return position


def _aligned(position: int, size: int) -> int:
    return (position + size - 1) // size * size


def names_in(types: Any, message_type: str, data: bytes, names: str = 'name') -> list[str]:
    """
    Return the names that a message lists, such as the joints of a JointState.

    Raises
    ------
    ValueError
        The message is shorter than its type.

    """
    field = Field(names, [], np.dtype('u1'), False, types, message_type)
    walk = _Walk(field, data)
    try:
        return walk.names(*walk.to(message_type, names, 0))
    except (struct.error, IndexError, UnicodeDecodeError):
        raise ValueError(SHORTER) from None
