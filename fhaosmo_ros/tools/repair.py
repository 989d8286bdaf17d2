# SPDX-License-Identifier: Apache-2.0
"""Saving what is whole of a bag whose writer was killed, or whose file was cut."""

from pathlib import Path
import shutil
import sqlite3
import struct

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.tools.bag_copy import copy_topics
from fhaosmo_ros.tools.bag_reader import BagReader
from fhaosmo_ros.tools.bag_writer import BagWriter
from fhaosmo_ros.tools.output import Output

MAGIC = b'\x89MCAP0\r\n'
CHUNK, DATA_END, FOOTER = 0x06, 0x0F, 0x02
EMPTY_FOOTER = struct.pack('<BQQQI', FOOTER, 20, 0, 0, 0) + MAGIC


def repair(bag: Path, final: Path, force: bool, storage: str) -> int:
    """
    Write a new bag with every message of a damaged one that can be read.

    Returns
    -------
    int
        Number of messages saved.

    Raises
    ------
    ConfigurationError
        There is nothing to save.

    """
    files = sorted([*bag.glob('*.mcap'), *bag.glob('*.db3')]) if bag.is_dir() else [bag]
    if not files or not files[0].is_file() or files[0].suffix not in ('.mcap', '.db3'):
        raise ConfigurationError(
            f'bag {bag}: expected a folder with an .mcap or a .db3 file, or that file, got neither'
        )
    with Output(final, force) as output:
        with BagWriter(output.path, storage=storage) as writer:
            for file in files:
                copy = output.path.with_name(f'whole{file.suffix}')
                offsets = _whole_mcap(file, copy) if file.suffix == '.mcap' else None
                if offsets is None:
                    _whole_sqlite(file, copy)
                with BagReader(copy) as reader:
                    if offsets:
                        reader.index_chunks(offsets)
                    for _ in copy_topics(reader, writer):
                        pass
            count = writer.count
        if not count:
            raise ConfigurationError(f'bag {bag}: expected a whole message, got none')
        output.keep()
    return count


def _whole_mcap(file: Path, copy: Path) -> list[int]:
    """Copy the whole records of a file and end them properly; return where its chunks begin."""
    size, chunks = file.stat().st_size, []
    with file.open('rb') as source:
        if source.read(len(MAGIC)) != MAGIC:
            raise ConfigurationError(f'file {file}: expected mcap, got something else')
        while True:
            begin = source.tell()
            head = source.read(9)
            if len(head) < 9 or head[0] in (DATA_END, FOOTER, 0):
                break
            end = begin + 9 + int.from_bytes(head[1:], 'little')
            if end > size:
                break
            if head[0] == CHUNK:
                chunks.append(begin)
            source.seek(end)
        source.seek(0)
        with copy.open('wb') as target:
            left = begin
            while left:
                left -= target.write(source.read(min(left, 1 << 20)))
            target.write(EMPTY_FOOTER)
    return chunks


def _whole_sqlite(file: Path, copy: Path) -> None:
    """Copy a database, and take back the transaction that was cut."""
    for suffix in ('', '-journal', '-wal'):
        part = file.with_name(file.name + suffix)
        if part.exists():
            shutil.copy(part, copy.with_name(copy.name + suffix))
    connection = sqlite3.connect(copy)
    try:
        connection.execute('SELECT count(*) FROM sqlite_master').fetchone()
        connection.execute('PRAGMA journal_mode = DELETE')
    except sqlite3.DatabaseError as error:
        raise ConfigurationError(f'file {file}: expected a database, got: {error}') from None
    finally:
        connection.close()
