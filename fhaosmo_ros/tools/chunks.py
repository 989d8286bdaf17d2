# SPDX-License-Identifier: Apache-2.0
"""The message records inside a chunk of an mcap file, found and copied."""

from typing import NamedTuple

from fhaosmo_ros.core.compile_cache import compile_cache
import numpy as np
from numpy.typing import NDArray

with compile_cache():
    from fhaosmo_ros.tools import chunk_kernels

Bytes = NDArray[np.uint8]
MESSAGE, DATA_AT = chunk_kernels.MESSAGE, chunk_kernels.DATA_AT
"""Opcode of a message record; how far behind its begin the message in CDR begins."""


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
    wanted = np.zeros(65536, dtype=np.bool_)
    wanted[channels] = True
    found = np.empty((4, chunk.size // DATA_AT + 1), dtype=np.int64)
    count = chunk_kernels.find_records(chunk, wanted, found)
    if count < 0:
        raise ValueError('a record goes beyond the end of its chunk')
    return Records(*found[:, :count].copy())


def copy(chunk: Bytes, records: Records, channels: NDArray[np.int64]) -> tuple[Bytes, Records]:
    """Return the records' bytes alone, under other channel numbers, and where they lie now."""
    ends = np.cumsum(records.ends - records.starts)
    out = np.empty(int(ends[-1]) if len(ends) else 0, dtype=np.uint8)
    chunk_kernels.copy_records(chunk, records.starts, records.ends, channels, out)
    starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)
    return out, Records(records.times, channels, starts, ends)


def gather(chunk: Bytes, at: NDArray[np.int64], kind: np.dtype) -> NDArray:
    """Return the numbers of a type that begin at the given places."""
    places = at[:, np.newaxis] + np.arange(kind.itemsize)
    return chunk[places].view(kind)[:, 0]
