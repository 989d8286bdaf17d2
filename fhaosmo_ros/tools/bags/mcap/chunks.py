# SPDX-License-Identifier: Apache-2.0
"""
The message records inside a chunk of an mcap file, found and copied by compiled loops.

rosbags makes a Python object of every message: reading and deserialising a Float64 takes it 1.9
microseconds. Whole chunks, with cdr.py behind, take 0.05 microseconds a sample.
"""

from collections.abc import Sequence
import struct
from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
import numpy as np
from numpy.typing import NDArray

try:
    from compression import zstd
except ImportError:  # before Python 3.14
    from backports import zstd

Bytes = NDArray[np.uint8]
CHUNK = 6
"""Opcode of a chunk."""
MESSAGE = 5
"""
Opcode of a message.

Its record is: opcode (1 byte), length (8), channel (2), sequence (4), log time (8), publish time
(8), message in CDR.
"""
LENGTH_AT, CHANNEL_AT, TIME_AT, PUBLISHED_AT, DATA_AT = 1, 9, 15, 23, 31
"""Offsets in the record of a message."""
ZSTD = b'\x28\xb5\x2f\xfd'
"""Begin of what zstd has compressed."""
MESSAGE_HEAD = struct.Struct('<BQHIQQ')
CHANNELS = 65536
"""A channel's number has two bytes."""


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


def scan(chunk: Bytes, channels: list[int]) -> Records:
    """
    Find the messages of some channels.

    Raises
    ------
    ValueError
        The chunk's records do not fit into it.

    """
    wanted = np.zeros(CHANNELS, dtype=np.bool_)
    wanted[channels] = True
    found = np.empty((4, chunk.size // DATA_AT + 1), dtype=np.int64)
    count = _find_records(chunk, wanted, found)
    if count < 0:
        raise ValueError('a record goes beyond the end of its chunk')
    return Records(*found[:, :count].copy())


def copy(chunk: Bytes, records: Records, channels: NDArray[np.int64]) -> tuple[Bytes, Records]:
    """Return the records' bytes alone, under other channel numbers, and where they lie now."""
    ends = np.cumsum(records.ends - records.starts)
    out = np.empty(int(ends[-1]) if len(ends) else 0, dtype=np.uint8)
    _copy_records(chunk, records.starts, records.ends, channels, out)
    starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)
    return out, Records(records.times, channels, starts, ends)


def pack(
    channels: Sequence[int], stamps: Sequence[int], texts: Sequence[bytes]
) -> tuple[Bytes, Records]:
    """Return records of messages in CDR, with the stamps as log and publish times."""
    heads = [
        MESSAGE_HEAD.pack(MESSAGE, DATA_AT - CHANNEL_AT + len(text), channel, 0, stamp, stamp)
        for channel, stamp, text in zip(channels, stamps, texts, strict=True)
    ]
    data = b''.join([part for pair in zip(heads, texts, strict=True) for part in pair])
    ends = np.cumsum([DATA_AT + len(text) for text in texts])
    starts = np.concatenate([[0], ends[:-1]])
    times = np.array(stamps, dtype=np.int64)
    records = Records(times, np.array(channels, dtype=np.int64), starts, ends)
    return np.frombuffer(data, dtype=np.uint8), records


def decompress_message(data: bytes) -> bytes:
    """
    Return a message in CDR, which rosbag2 may have compressed alone.

    metadata.yaml says so as well, but it may be lost. A message in CDR begins with a zero.
    """
    return zstd.decompress(data) if data[: len(ZSTD)] == ZSTD else data


def decompress_messages(chunk: Bytes, records: Records) -> tuple[Bytes, Records]:
    """Return records whose messages are in CDR; the same ones, if they are not compressed."""
    at = records.starts + DATA_AT
    at = at[records.ends - at >= len(ZSTD)]
    if not (gather(chunk, at, np.dtype('<u4')) == int.from_bytes(ZSTD, 'little')).any():
        return chunk, records
    parts, ends = [], []
    for start, end in zip(records.starts.tolist(), records.ends.tolist(), strict=True):
        text = decompress_message(chunk[start + DATA_AT : end].tobytes())
        length = (DATA_AT - CHANNEL_AT + len(text)).to_bytes(8, 'little')
        head = chunk[start + CHANNEL_AT : start + DATA_AT].tobytes()
        parts += [bytes([MESSAGE]), length, head, text]
        ends.append(DATA_AT + len(text))
    ends = np.cumsum(ends)
    starts = np.concatenate([[0], ends[:-1]])
    plain = np.frombuffer(b''.join(parts), dtype=np.uint8)
    return plain, Records(records.times, records.channels, starts, ends)


def gather(chunk: Bytes, at: NDArray[np.int64], kind: np.dtype) -> NDArray:
    """Return the numbers of a type that begin at the given places."""
    places = at[:, np.newaxis] + np.arange(kind.itemsize)
    return chunk[places].view(kind)[:, 0]


@compiled()
def _number(chunk: Bytes, at: int, size: int) -> int:
    """Return the little-endian integer of `size` bytes."""
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(chunk[at + k]) << np.uint64(8 * k)
    return np.int64(value)


@compiled()
def _find_records(chunk: Bytes, wanted: NDArray[np.bool_], out: NDArray[np.int64]) -> int:
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


@compiled()
def end_of_run(data: Bytes, position: int, end: int, size: int) -> int:
    """Return where the record ends that reaches `size` bytes, or a chunk begins; -1 if cut."""
    limit = min(end, position + size)
    while position < limit and data[position] != CHUNK:
        if position + CHANNEL_AT > end:
            return -1
        following = position + CHANNEL_AT + _number(data, position + LENGTH_AT, 8)
        if following > end or following < position:
            return -1
        position = following
    return position


@compiled()
def _copy_records(
    chunk: Bytes,
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    channels: NDArray[np.int64],
    out: Bytes,
) -> None:
    """Copy records one behind the other, under other channel numbers."""
    position = 0
    for k in range(starts.size):
        size = ends[k] - starts[k]
        out[position : position + size] = chunk[starts[k] : ends[k]]
        out[position + CHANNEL_AT] = channels[k] & 255
        out[position + CHANNEL_AT + 1] = channels[k] >> 8
        position += size
