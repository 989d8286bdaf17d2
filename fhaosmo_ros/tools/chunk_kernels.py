# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over the records of an mcap chunk; to be imported by chunks.py only."""

from numba import njit
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
MESSAGE = 5
"""Opcode; its record is: opcode (1 byte), length (8), channel (2), sequence (4), log time (8)."""
LENGTH_AT, CHANNEL_AT, TIME_AT, DATA_AT = 1, 9, 15, 31
"""Offsets in a message record: then comes the publish time (8), then the message in CDR."""


@njit(cache=True)
def _number(chunk: Bytes, at: int, size: int) -> int:
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(chunk[at + k]) << np.uint64(8 * k)
    return np.int64(value)


@njit(cache=True)
def find_records(chunk: Bytes, wanted: NDArray[np.bool_], out: NDArray[np.int64]) -> int:
    """Write time, channel, begin and end of the wanted messages; return their number or -1."""
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
def copy_records(
    chunk: Bytes, starts: NDArray[np.int64], ends: NDArray[np.int64],
    channels: NDArray[np.int64], out: Bytes,
) -> None:  # fmt: skip
    """Copy records one behind the other, under other channel numbers."""
    position = 0
    for k in range(starts.size):
        size = ends[k] - starts[k]
        out[position : position + size] = chunk[starts[k] : ends[k]]
        out[position + CHANNEL_AT] = channels[k] & 255
        out[position + CHANNEL_AT + 1] = channels[k] >> 8
        position += size
