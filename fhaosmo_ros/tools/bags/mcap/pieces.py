# SPDX-License-Identifier: Apache-2.0
"""Where the messages of an mcap file lie, and their bytes, checked by the CRCs of the file."""

from pathlib import Path
import struct
from typing import NamedTuple
from zlib import crc32

from fhaosmo_ros.tools.bags.mcap.chunks import Bytes, CHUNK, end_of_run, scan
import numpy as np
from rosbags.rosbag2.storage_mcap import decompress, McapReader

FOOTER_SIZE = 37
"""Bytes of the footer, with the magic number behind it."""
RUN = 1 << 22
"""Bytes of messages outside chunks that are taken as one piece."""


class Piece(NamedTuple):
    """
    Messages that lie together: a chunk, or a run of messages outside chunks.

    Attributes
    ----------
    first, last : int
        Range of the log times in nanoseconds.
    offset, size : int
        Where the messages begin in the file, and how many bytes they take there.
    compression : str
        'zstd', 'lz4' or ''.
    plain : int
        Bytes without compression.
    crc_at : int
        Where the file has their CRC, 0 for a run.
    counts : dict
        Number of messages of each channel; 1 for all channels where that is not known.

    """

    first: int
    last: int
    offset: int
    size: int
    compression: str
    plain: int
    crc_at: int
    counts: dict[int, int]


def check_summary(path: Path) -> None:
    """
    Compare the summary of an mcap file, which holds its topics and its index, with its CRC.

    Raises
    ------
    ValueError
        They differ.

    """
    with path.open('rb') as file:
        size = file.seek(0, 2)
        if size < FOOTER_SIZE:
            return  # rosbags says what is missing
        file.seek(size - FOOTER_SIZE)
        _, _, start, _, crc = struct.unpack('<BQQQI', file.read(29))
        begin = start or size - FOOTER_SIZE
        if not crc or begin > size:
            return
        file.seek(begin)
        if crc32(file.read(size - 12 - begin)) != crc:
            raise ValueError('the summary does not agree with its CRC')


def find_pieces(storage: McapReader) -> list[Piece]:
    """
    Return the pieces of an open file in its order; without an index, by going through it.

    Raises
    ------
    ValueError
        A record goes beyond the end of the file.

    """
    if not storage.chunks:
        return _walk(storage)
    return [
        Piece(
            chunk.message_start_time,
            chunk.message_end_time,
            chunk.chunk_start_offset + 9 + 40 + len(chunk.compression),
            chunk.compressed_size,
            chunk.compression,
            chunk.uncompressed_size,
            chunk.chunk_start_offset + 9 + 24,
            chunk.channel_count,
        )
        for chunk in storage.chunks
    ]


def _walk(storage: McapReader) -> list[Piece]:
    data = np.asarray(np.memmap(storage.path, dtype=np.uint8, mode='r'))
    ids = [c.id for c in storage.connections]
    position, end = storage.data_start, storage.data_end
    found = []
    while position < end:
        if data[position] == CHUNK:
            length, first, last, plain, _, letters = struct.unpack_from(
                '<QQQQII', data, position + 1
            )
            compression = data[position + 41 : position + 41 + letters].tobytes().decode()
            (size,) = struct.unpack_from('<Q', data, position + 41 + letters)
            offset = position + 49 + letters
            every = dict.fromkeys(ids, 1)
            found.append(
                Piece(first, last, offset, size, compression, plain, position + 33, every)
            )
            position += 9 + length
            continue
        stop = end_of_run(data, position, end, RUN)
        if stop < 0:
            raise ValueError('a record goes beyond the end of the file')
        records = scan(data[position:stop], ids)
        if len(records.times):
            low, high = int(records.times.min()), int(records.times.max())
            channels, counts = np.unique(records.channels, return_counts=True)
            number = dict(zip(channels.tolist(), counts.tolist(), strict=True))
            size = stop - position
            found.append(Piece(low, high, position, size, '', size, 0, number))
        position = stop
    return found


def load(storage: McapReader, piece: Piece) -> tuple[Bytes, bool]:
    """
    Return a piece's bytes without compression, and whether a CRC proved them.

    Raises
    ------
    Exception
        They do not agree with their CRC, or cannot be decompressed.

    """
    crc = 0
    if piece.crc_at:
        storage.bio.seek(piece.crc_at)
        crc = int.from_bytes(storage.bio.read(4), 'little')
    storage.bio.seek(piece.offset)
    packed = storage.bio.read(piece.size)
    plain = decompress(packed, piece.compression, piece.plain, crc)
    return np.frombuffer(plain, dtype=np.uint8), crc != 0
