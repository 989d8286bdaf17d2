# SPDX-License-Identifier: Apache-2.0
"""
A number out of each of many messages in CDR, all at once.

Where a number lies in a message depends on the lengths of the strings and lists before it. These
are mostly the same in message after message. So one message is parsed, and the others are compared
with it in the few places where these lengths stand: those that agree give their number by the same
offset, as an array. This takes 0.05 microseconds a sample, rosbags' own deserialiser 1.9.
"""

import struct
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.fields import ARRAY, BASE, Field, KINDS, NAME, SEQUENCE
from fhaosmo_ros.tools.bags.mcap.chunks import gather
import numpy as np
from numpy.typing import NDArray

HEADER = 4
"""Bytes before a message's first field; the second of them says the byte order."""
WORD = np.dtype('<u4')
GROUPS = 8
"""Groups of messages with equal lengths that a block may have; further messages go one by one."""


class Layout(NamedTuple):
    """
    Offset of a number in all messages that have the same words in the same places.

    Attributes
    ----------
    offset : int
        Distance of the number from the message's first byte.
    words : list of (int, bytes)
        Offset and content of the message's first four bytes, and of each length before the number.
    order : str
        '<' or '>'.

    """

    offset: int
    words: list[tuple[int, bytes]]
    order: str


def locate(field: Field, data: bytes, width: int = 1) -> Layout:
    """
    Find a field, the first of `width` neighbours, in a message.

    Raises
    ------
    ConfigurationError
        A list in this message is too short.
    ValueError
        The message is shorter than its type.

    """
    if len(data) < HEADER:
        raise ValueError('a message is shorter than its type')
    walk = _Walk(field, data, width)
    try:
        offset = walk.to_number()
    except (struct.error, IndexError):
        offset = len(data)
    if offset + width * field.kind.itemsize > len(data):
        raise ValueError('a message is shorter than its type')
    return Layout(offset, [(0, data[:HEADER]), *walk.words], walk.order)


class _Walk:
    """Parses a message as far as the field; positions count from behind its first four bytes."""

    def __init__(self, field: Field, data: bytes, width: int) -> None:
        self._field, self._data, self._width = field, data, width
        self.order = '<' if data[1] & 1 else '>'
        self.words: list[tuple[int, bytes]] = []

    def to_number(self) -> int:
        node: Any = (NAME, self._field.message_type)
        position = 0
        for step in self._field.steps:
            if isinstance(step, str):
                for name, inner in self._field.types[node[1]][1]:
                    if name == step:
                        node = inner
                        break
                    position = self._past(inner, position)
            else:
                count = node[1][1]
                if node[0] == SEQUENCE:
                    count, position = self._length(position)
                last = step + self._width - 1
                if last >= count:
                    raise ConfigurationError(
                        f'field {self._field.text!r}: expected an index below the number of '
                        f'elements, {count} in one message, got {last}'
                    )
                node = node[1][0]
                position = self._past_many(node, step, position)
        return HEADER + _aligned(position, self._field.kind.itemsize)

    def _length(self, position: int) -> tuple[int, int]:
        at = HEADER + _aligned(position, 4)
        word = self._data[at : at + 4]
        self.words.append((at, word))
        return struct.unpack(f'{self.order}I', word)[0], at - HEADER + 4

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


def numbers(
    field: Field,
    data: NDArray[np.uint8],
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    width: int = 1,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """
    Return a field's values, and the stamps (ns) in the headers, zeros where there are none.

    Parameters
    ----------
    field : Field
    data : (B,) array
        Bytes of the messages.
    starts, ends : (K,) arrays
        Where each begins and ends.
    width : int
        Number of neighbours in a list, from the field on; above 1, the values are (K, width).

    Raises
    ------
    ConfigurationError, ValueError
        As `locate`.

    """
    values = np.empty((len(starts), width))
    stamps = np.zeros(len(starts), dtype=np.int64)
    left, groups = np.arange(len(starts)), 0
    while len(left):
        groups += 1
        k = left[0]
        layout = locate(field, data[starts[k] : ends[k]].tobytes(), width)
        kind = field.kind.newbyteorder(layout.order)
        same = left if groups <= GROUPS else left[:1]
        same = same[ends[same] - starts[same] >= layout.offset + width * kind.itemsize]
        for at, word in layout.words:
            same = same[gather(data, starts[same] + at, WORD) == np.frombuffer(word, WORD)]
        at = starts[same]
        for k in range(width):
            values[same, k] = gather(data, at + layout.offset + k * kind.itemsize, kind)
        if field.has_header:
            seconds = gather(data, at + HEADER, np.dtype(f'{layout.order}i4')).astype(np.int64)
            rest = gather(data, at + HEADER + 4, np.dtype(f'{layout.order}u4'))
            stamps[same] = seconds * 1_000_000_000 + rest
        left = np.setdiff1d(left, same, assume_unique=True) if len(same) < len(left) else []
    return values if width > 1 else values[:, 0], stamps
