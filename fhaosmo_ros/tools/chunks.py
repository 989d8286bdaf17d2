# SPDX-License-Identifier: Apache-2.0
"""The message records inside a chunk of an mcap file, found and copied by compiled code."""

from typing import NamedTuple

from numba import njit
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
MESSAGE = 5
"""Opcode; its record is: opcode (1 byte), length (8), channel (2), sequence (4), log time (8)."""
LENGTH_AT, CHANNEL_AT, TIME_AT, DATA_AT = 1, 9, 15, 31
"""Offsets in a message record: then comes the publish time (8), then the message in CDR."""


class Records(NamedTuple):
    """
    Message records of a chunk, in its order.

    Attributes
    ----------
    times : (K,) array of int
        Log times in nanoseconds.
    channels : (K,) array of int
    starts, ends : (K,) arrays of int
        Where a record begins and ends in the chunk.

    """

    times: NDArray[np.int64]
    channels: NDArray[np.int64]
    starts: NDArray[np.int64]
    ends: NDArray[np.int64]


@njit(cache=True)
def _number(chunk: Bytes, at: int, size: int) -> int:
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(chunk[at + k]) << np.uint64(8 * k)
    return np.int64(value)


@njit(cache=True)
def _scan(chunk: Bytes, wanted: NDArray[np.bool_], out: NDArray[np.int64]) -> int:
    position, count = 0, 0
    while position < chunk.size:
        if position + CHANNEL_AT > chunk.size:
            return -1
        end = position + CHANNEL_AT + _number(chunk, position + LENGTH_AT, 8)
        if end > chunk.size or end < position:
            return -1
        if chunk[position] == MESSAGE:
            if end < position + DATA_AT:
                return -1
            channel = _number(chunk, position + CHANNEL_AT, 2)
            if wanted[channel]:
                out[0, count] = _number(chunk, position + TIME_AT, 8)
                out[1, count] = channel
                out[2, count] = position
                out[3, count] = end
                count += 1
        position = end
    return count


@njit(cache=True)
def _copy(
    chunk: Bytes, starts: NDArray[np.int64], ends: NDArray[np.int64],
    channels: NDArray[np.int64], out: Bytes,
) -> None:  # fmt: skip
    position = 0
    for k in range(starts.size):
        size = ends[k] - starts[k]
        out[position : position + size] = chunk[starts[k] : ends[k]]
        out[position + CHANNEL_AT] = channels[k] & 255
        out[position + CHANNEL_AT + 1] = channels[k] >> 8
        position += size


def scan(chunk: Bytes, channels: list[int]) -> Records:
    """
    Find the messages of some channels.

    Raises
    ------
    ValueError
        The chunk's records do not fit into it.

    """
    wanted = np.zeros(65536, dtype=np.bool_)
    wanted[channels] = True
    found = np.empty((4, chunk.size // DATA_AT + 1), dtype=np.int64)
    count = _scan(chunk, wanted, found)
    if count < 0:
        raise ValueError('a record goes beyond the end of its chunk')
    return Records(*found[:, :count].copy())


def copy(chunk: Bytes, records: Records, channels: NDArray[np.int64]) -> tuple[Bytes, Records]:
    """Return the records' bytes alone, under other channel numbers, and where they lie now."""
    ends = np.cumsum(records.ends - records.starts)
    out = np.empty(int(ends[-1]) if len(ends) else 0, dtype=np.uint8)
    _copy(chunk, records.starts, records.ends, channels, out)
    starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)
    return out, Records(records.times, channels, starts, ends)


def gather(chunk: Bytes, at: NDArray[np.int64], kind: np.dtype) -> NDArray:
    """Return the numbers of a type that begin at the given places."""
    places = at[:, np.newaxis] + np.arange(kind.itemsize)
    return chunk[places].view(kind)[:, 0]
