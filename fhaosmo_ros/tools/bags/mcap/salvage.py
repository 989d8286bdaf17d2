# SPDX-License-Identifier: Apache-2.0
"""The whole records of a damaged mcap file, copied into a file that every reader takes."""

from collections.abc import Iterator
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.mcap.chunks import CHANNELS, CHUNK, MESSAGE, scan
from fhaosmo_ros.tools.bags.mcap.pieces import check_summary
from fhaosmo_ros.tools.bags.mcap.writer import (
    CHANNEL,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE_INDEX,
    METADATA,
    record,
    SCHEMA,
    text,
)
import numpy as np
from rosbags.rosbag2.storage_mcap import decompress

LAST_OPCODE = DATA_END
BLOCK = 1 << 24
"""Bytes that are searched at once for the next record."""


class Loss(NamedTuple):
    """
    What a repair left out.

    Attributes
    ----------
    offset, size : int
        Bytes of the file.
    reason : str
    messages : int or None
        None if not known.
    span : (int, int) or None
        First and last log time in nanoseconds.

    """

    offset: int
    size: int
    reason: str
    messages: int | None = None
    span: tuple[int, int] | None = None

    def __str__(self) -> str:
        where = f'{self.size} bytes at {self.offset}: {self.reason}'
        if self.messages is not None:
            where += f'; {self.messages} messages'
        if self.span:
            first, last = (f'{stamp / 1e9:.3f}' for stamp in self.span)
            where += f', log times from {first} to {last} s'
        return where


def salvage(file: Path, copy: Path) -> list[Loss]:
    """
    Copy the records of a damaged file that can be trusted; return what is missing.

    A chunk is trusted if it agrees with its CRC. Where it has none, its records must fit into it.

    Parameters
    ----------
    file : path
    copy : path
        File to write; it has neither index nor summary.

    Raises
    ------
    ConfigurationError
        It is not an mcap file.

    """
    losses: list[Loss] = []
    with file.open('rb') as source, copy.open('wb') as target:
        if source.read(len(MAGIC)) != MAGIC:
            raise ConfigurationError(f'file {file}: expected mcap, got something else')
        target.write(MAGIC + record(HEADER, text('ros2') + text('fhaosmo_ros')))
        size = source.seek(0, 2)
        topics, proven = _topics_of_summary(file, source, size)
        if proven:
            target.write(topics)
        for content in _trusted(source, size, losses):
            target.write(content)
        if not proven:  # behind the file's own, which readers then prefer
            target.write(topics)
        target.write(record(DATA_END, bytes(4)))
        target.write(record(FOOTER, bytes(20)) + MAGIC)
    return losses


def _topics_of_summary(file: Path, source: BinaryIO, size: int) -> tuple[bytes, bool]:
    """Return the summary's schemas and channels, and whether they agree with a CRC."""
    topics = b''
    try:
        check_summary(file)
        source.seek(size - 28)
        start, offsets, crc = struct.unpack('<QQI', source.read(20))
        if not len(MAGIC) < start < offsets < size:
            return b'', False
        source.seek(start)
        summary = source.read(offsets - start)
        at = 0
        while at < len(summary):
            (length,) = struct.unpack_from('<Q', summary, at + 1)
            if summary[at] in (SCHEMA, CHANNEL):
                topics += summary[at : at + 9 + length]
            at += 9 + length
    except (ValueError, struct.error, OSError):
        return b'', False
    return topics, crc != 0


def _trusted(source: BinaryIO, size: int, losses: list[Loss]) -> Iterator[bytes]:
    """Yield topics, messages and chunks up to the end of the data; go on behind damage."""
    position, held = len(MAGIC), b''  # a message is held until the record behind it is whole
    while position < size:
        end = _end_of_record(source, position, size)
        source.seek(position)
        content = source.read(end - position) if end else b''
        loss = Loss(position, 0, 'no whole record')
        if content and content[0] == CHUNK:
            loss = _wrong_chunk(content, position)
            if loss and not _end_of_record(source, end, size):
                end = None  # its length is damaged, too
        if end is None:
            following = _next_record(source, position + 1, size, bool(held))
            losses.append(loss._replace(size=following - position))
            position, held = following, b''
            continue
        if held:
            yield held
            held = b''
        if content[0] == DATA_END and len(content) == 13:
            return
        if content[0] == MESSAGE:
            held = content
        elif content[0] == CHUNK and loss:
            losses.append(loss)
        elif content[0] in (SCHEMA, CHANNEL, CHUNK):
            yield content
        position = end


def _end_of_record(source: BinaryIO, position: int, size: int) -> int | None:
    source.seek(position)
    head = source.read(9)
    if len(head) < 9 or not 0 < head[0] <= LAST_OPCODE:
        return None
    end = position + 9 + int.from_bytes(head[1:], 'little')
    return end if end <= size else None


def _next_record(source: BinaryIO, position: int, size: int, take_messages: bool) -> int:
    """
    Return where the next record begins that is followed by others, or the end of the file.

    Messages inside a chunk look like those of a file without chunks, but they have lost the CRC of
    the chunk. So messages count only in a file without chunks.
    """
    opcodes = [CHUNK, MESSAGE_INDEX, METADATA, DATA_END, SCHEMA, CHANNEL]
    opcodes += [MESSAGE] if take_messages else []
    while position < size:
        source.seek(position)
        block = np.frombuffer(source.read(BLOCK + 8), dtype=np.uint8)
        count = len(block) - 8
        if count <= 0:
            break
        likely = np.isin(block[:count], opcodes)
        # The upper three bytes of a length are zero.
        for k in (6, 7, 8):
            likely &= block[k : count + k] == 0
        for at in np.flatnonzero(likely).tolist():
            if _fits(source, position + at, size):
                return position + at
        position += count
    return size


def _fits(source: BinaryIO, position: int, size: int) -> bool:
    """Return True if two whole records follow, the first of a plausible form."""
    end = _end_of_record(source, position, size)
    if end is None:
        return False
    source.seek(position)
    head = source.read(15)
    if head[0] == MESSAGE_INDEX:  # a message index: channel, and the length of its entries
        (extent,) = struct.unpack_from('<I', head, 11)
        if extent % 16 or end - position != 15 + extent:
            return False
    if head[0] == DATA_END and end - position != 13:
        return False
    following = _end_of_record(source, end, size)
    return following is not None and _end_of_record(source, following, size) is not None


def _wrong_chunk(content: bytes, offset: int) -> Loss | None:
    """Return what is lost with a chunk that cannot be trusted, None if it can."""
    span = None
    try:
        first, last, plain, crc, letters = struct.unpack_from('<QQQII', content, 9)
        span = (first, last) if first <= last < 2**63 else None
        compression = content[41 : 41 + letters].decode()
        (size,) = struct.unpack_from('<Q', content, 41 + letters)
        data = content[49 + letters :]
        if size != len(data):
            raise ValueError('its sizes differ')
        bytes_ = np.frombuffer(decompress(data, compression, plain, crc), dtype=np.uint8)
        scan(bytes_, list(range(CHANNELS)))
    except Exception as error:  # of rosbags, lz4, zstd
        reason = ' '.join(str(error).split()) or type(error).__name__
        return Loss(offset, len(content), f'a chunk: {reason}', None, span)
    return None
