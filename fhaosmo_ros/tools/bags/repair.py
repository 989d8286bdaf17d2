# SPDX-License-Identifier: Apache-2.0
"""
Saving the whole messages of a bag that was cut short or is damaged.

What can be trusted is copied into a whole storage file, which is then read as any other.
"""

from pathlib import Path
import shutil
import sqlite3
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.copy import copy_topics
from fhaosmo_ros.tools.bags.mcap.salvage import salvage
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.writer import BagWriter
import numpy as np

ROWS = 4096
"""Messages that are read from a database at once."""
PROBES = 16
"""Ids of a range that are looked up; if none can be read, the whole range counts as lost."""
SMALLEST_ROW = 32
"""Bytes of a message in a database, at least."""


def repair(bag: Path, output: Path, storage: str) -> tuple[int, list[str]]:
    """
    Write a new bag with every message of a damaged one that can be read.

    Parameters
    ----------
    bag : path
        Folder or storage file of the damaged bag; stays as it is.
    output : path
        Folder to make. Beside it lie copies of the storage files, which the caller removes.
    storage : {'mcap', 'sqlite3'}
        Of the new bag.

    Returns
    -------
    int
        Number of messages saved.
    list of str
        What is missing: bytes, messages and times, as far as they are known.

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
    missing: list[str] = []
    with BagWriter(output, storage=storage) as writer:
        for file in files:
            copy = output.with_name(f'whole{file.suffix}')
            if file.suffix == '.mcap':
                missing += [f'{file.name}: {loss}' for loss in salvage(file, copy)]
            else:
                missing += [f'{file.name}: {loss}' for loss in _whole_sqlite(file, copy)]
            with BagReader(copy) as reader:
                for _ in copy_topics(reader, writer):
                    pass
        count = writer.count
    if not count:
        raise ConfigurationError(f'bag {bag}: expected a whole message, got none')
    return count, missing


def _whole_sqlite(file: Path, copy: Path) -> list[str]:
    """
    Copy the rows of a database that can be read; return what is missing.

    A transaction that was cut is taken back. sqlite3 refuses every query on a file that is shorter
    than its header says, so zeros are put behind it; it then refuses only pages that are damaged.
    """
    part = copy.with_name(f'damaged{file.suffix}')
    copy.unlink(missing_ok=True)  # of another file of the bag
    for suffix in ('', '-journal', '-wal'):
        other, its_copy = (f.with_name(f.name + suffix) for f in (file, part))
        its_copy.unlink(missing_ok=True)  # of another file of the bag
        if other.exists():
            shutil.copy(other, its_copy)
    missing = []
    with part.open('r+b') as stream:
        head = stream.read(32)
        size = part.stat().st_size
        page = int.from_bytes(head[16:18], 'big')
        whole = int.from_bytes(head[28:32], 'big') * (65536 if page == 1 else page)
        if size < whole <= size + (1 << 40) and not any(part.parent.glob(f'{part.name}-*')):
            stream.truncate(size // page * page)  # a part of a page has wrong rows
            stream.truncate(whole)
            missing.append(f'{whole - size} bytes at its end')
    source, target = sqlite3.connect(part), sqlite3.connect(copy)
    try:
        for (statement,) in source.execute(
            "SELECT sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
        ).fetchall():
            target.execute(statement)
        for (table,) in target.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table'"
        ).fetchall():
            if table != 'messages':
                _copy_rows(source, target, f'SELECT * FROM "{table}"', table)
        missing += _copy_messages(source, target)
        target.commit()
    except sqlite3.Error as error:
        raise ConfigurationError(f'file {file}: expected a database, got: {error}') from None
    finally:
        source.close()
        target.close()
    return missing


def _copy_rows(
    source: sqlite3.Connection, target: sqlite3.Connection, query: str, table: str
) -> list[Any]:
    rows = source.execute(query).fetchall()
    if rows:
        places = ','.join('?' * len(rows[0]))
        target.executemany(f'INSERT INTO "{table}" VALUES ({places})', rows)
    return rows


def _copy_messages(source: sqlite3.Connection, target: sqlite3.Connection) -> list[str]:
    """Copy the messages in ranges of ids, halved where a page in them is damaged."""
    highest = _highest_id(source)
    missing, ranges = [], [(k, k + ROWS) for k in range(0, highest + 1, ROWS)][::-1]
    stamp = None
    while ranges:
        low, high = ranges.pop()
        query = f'SELECT * FROM messages WHERE id >= {low} AND id < {high} ORDER BY id'
        try:
            rows = source.execute(query).fetchall()
        except sqlite3.DatabaseError as error:
            if high - low > 1 and not _all_lost(source, low, high):
                middle = (low + high) // 2
                ranges += [(middle, high), (low, middle)]
                continue
            if missing and missing[-1][1] == low:
                missing[-1] = (missing[-1][0], high, *missing[-1][2:])
            else:
                missing.append((low, high, stamp, str(error)))
        else:
            whole = _whole_rows(rows)
            target.executemany('INSERT INTO messages VALUES (?, ?, ?, ?)', whole)
            if len(whole) < len(rows):
                missing.append((low, high, stamp, 'rows that are not whole'))
            stamp = whole[-1][2] if whole else stamp
    return [
        (f'messages {low} to {high - 1}' if high <= highest else f'messages from {low} on')
        + f': {error}'
        + ('' if at is None else f', after the stamp {at / 1e9:.3f} s')
        for low, high, at, error in missing
    ]


def _whole_rows(rows: list[Any]) -> list[Any]:
    """
    Return the rows of messages that can be trusted.

    A recorder numbers its messages without gaps. Where a number is missing or a row has wrong
    types, a part of a page was overwritten, and the neighbours may have lost a part of theirs.
    """
    ids = np.array([row[0] for row in rows], dtype=np.int64)
    good = np.array([tuple(map(type, row[1:4])) == (int, int, bytes) for row in rows], dtype=bool)
    follows = (np.diff(ids) == 1) & good[1:] & good[:-1]
    good[1:] &= follows
    good[:-1] &= follows
    return [row for row, is_whole in zip(rows, good.tolist(), strict=True) if is_whole]


def _all_lost(source: sqlite3.Connection, low: int, high: int) -> bool:
    """Return True if none of some ids can be looked up: so one page above them is damaged."""
    if high - low < PROBES:
        return False
    for k in range(low, high, (high - low) // PROBES):
        try:
            source.execute(f'SELECT data FROM messages WHERE id = {k}').fetchone()
        except sqlite3.DatabaseError:
            continue
        return False
    return True


def _highest_id(source: sqlite3.Connection) -> int:
    """Return the highest id of a message, or more where its page is damaged."""
    try:
        return int(source.execute('SELECT coalesce(max(id), 0) FROM messages').fetchone()[0])
    except sqlite3.DatabaseError:
        pages = source.execute('PRAGMA page_count').fetchone()[0]
        return int(pages * source.execute('PRAGMA page_size').fetchone()[0] // SMALLEST_ROW)
