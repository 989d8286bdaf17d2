# SPDX-License-Identifier: Apache-2.0
"""
A number out of each of many messages in CDR, all at once.

One message is parsed (messages/layout.py), and the others are compared with it in the few places
where lengths and names stand: those that agree give their number by the same offset, as an array.
This takes 0.05 microseconds a sample, rosbags' own deserialiser 1.9.
"""

from typing import NamedTuple

from fhaosmo_ros.messages.fields import angle_of, Field, MissingElementError
from fhaosmo_ros.messages.layout import HEADER, locate
from fhaosmo_ros.tools.bags.mcap.chunks import gather
import numpy as np
from numpy.typing import NDArray

WORD = np.dtype('<u4')
GROUPS = 8
"""Groups of messages with equal lengths that a block may have; further messages go one by one."""


class Column(NamedTuple):
    """
    A field of many messages.

    Attributes
    ----------
    values : (K,) or (K, width) array
        NaN where a message lacks the field.
    stamps : (K,) array of int
        Of the headers in nanoseconds, zeros where there are none.
    missing : dict of int to str
        Why, by the index of each message that lacks it.

    """

    values: NDArray[np.float64]
    stamps: NDArray[np.int64]
    missing: dict[int, str]


def numbers(
    field: Field,
    data: NDArray[np.uint8],
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    width: int = 1,
) -> Column:
    """
    Return a field's values.

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
    ValueError
        A message is shorter than its type.

    """
    count = max(width, field.width)
    values = np.full((len(starts), count), np.nan)
    stamps = np.zeros(len(starts), dtype=np.int64)
    missing: dict[int, str] = {}
    left, groups = np.arange(len(starts)), 0
    while len(left):
        groups += 1
        k = left[0]
        layout = locate(field, data[starts[k] : ends[k]].tobytes(), width)
        kind = field.kind.newbyteorder(layout.order)
        same = left if groups <= GROUPS else left[:1]
        least = [at + len(text) for at, text in layout.same]
        least.append(layout.offset + count * kind.itemsize)
        same = same[ends[same] - starts[same] >= max(least)]
        for at, word in _words(layout.same):
            same = same[gather(data, starts[same] + at, WORD) == np.frombuffer(word, WORD)]
        at = starts[same]
        if layout.missing:
            missing |= dict.fromkeys(same.tolist(), layout.missing)
        else:
            for k in range(count):
                values[same, k] = gather(data, at + layout.offset + k * kind.itemsize, kind)
        if field.has_header:
            seconds = gather(data, at + HEADER, np.dtype(f'{layout.order}i4')).astype(np.int64)
            rest = gather(data, at + HEADER + 4, np.dtype(f'{layout.order}u4'))
            stamps[same] = seconds * 1_000_000_000 + rest
        left = np.setdiff1d(left, same, assume_unique=True) if len(same) < len(left) else []
    if field.angle:
        values = np.array([[angle_of(field.angle, *row)] for row in values.tolist()])
    if width == 1:
        values = values.reshape(-1)
    return Column(values, stamps, missing)


def expect_all(column: Column) -> None:
    """
    Raise if a message lacks the field.

    Raises
    ------
    MissingElementError

    """
    if column.missing:
        raise MissingElementError(next(iter(column.missing.values())))


def _words(same: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Return pieces of at least four bytes in pieces of four; the last two may overlap."""
    words = []
    for at, text in same:
        last = len(text) - 4
        words += [(at + k, text[k : k + 4]) for k in (*range(0, last, 4), last)]
    return words
