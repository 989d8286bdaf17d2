# SPDX-License-Identifier: Apache-2.0
"""Where a study is kept: in memory, in a journal file, or in a data base at a URL."""

import fcntl
from importlib import import_module
import json
import logging
import os
from pathlib import Path
import time

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import optuna
from optuna.storages import BaseStorage, InMemoryStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend

POSTGRESQL_DRIVERS = ('psycopg', 'psycopg2', 'pg8000')
"""Modules that connect SQLAlchemy with PostgreSQL, the preferred one first."""
ATTEMPTS, PAUSE = 20, 0.25
"""How often, and seconds after which, to try again while another process creates the tables."""
LONGEST = 200
"""Characters of another library's error that are shown."""


def open_study(text: str | None, name: str) -> tuple[optuna.Study, bool]:
    """
    Return the study of a name, and whether it was made now.

    Parameters
    ----------
    text : str or None
        The storage: a journal file, or the URL of a data base; None for memory.
    name : str
        Of the study.

    Raises
    ------
    ConfigurationError
        The storage can't be opened.

    """
    try:
        storage = _open_storage(text)
        try:
            return optuna.create_study(storage=storage, study_name=name), True
        except optuna.exceptions.DuplicatedStudyError:
            return optuna.load_study(storage=storage, study_name=name), False
    except ConfigurationError:
        raise
    except Exception as error:  # SQLAlchemy and each driver have exceptions of their own
        raise ConfigurationError(
            f'storage {text!r}: expected a file to write a journal to, or the URL of a data base '
            f'such as sqlite:///study.db, got: {one_line(error)}'
        ) from None


def one_line(error: BaseException) -> str:
    """Return what went wrong, without the SQL statement and the advice that come with it."""
    # Optuna's own error says that there was an error; SQLAlchemy's holds that of the driver.
    while error.__cause__ is not None:
        error = error.__cause__
    return ' '.join(str(error).split())[:LONGEST] or type(error).__name__


def _open_storage(text: str | None) -> BaseStorage:
    if text is None:
        return InMemoryStorage()
    if '://' in text and not text.startswith('journal://'):
        return _open_database(_with_installed_driver(text))
    return _open_journal(Path(text.removeprefix('journal://')))


def _with_installed_driver(url: str) -> str:
    """
    Name a driver that is installed in a URL that names none.

    SQLAlchemy takes its default then, which changed from psycopg2 to psycopg in version 2.1, and
    fails if that one is not installed.
    """
    scheme, rest = url.split('://', 1)
    if scheme != 'postgresql':
        return url
    for driver in POSTGRESQL_DRIVERS:
        try:
            import_module(driver)
        except ImportError:  # not installed, or without the libpq that it needs
            continue
        return f'postgresql+{driver}://{rest}'
    raise ConfigurationError(
        f'storage {url!r}: expected one of {", ".join(POSTGRESQL_DRIVERS)} to be installed, found '
        "none: python3 -m pip install 'psycopg[binary]'"
    )


def _open_database(url: str) -> BaseStorage:
    """
    Open a data base, and create its tables if it is new.

    Optuna asks whether a table is there before it creates it: of two processes that do so at once
    one fails.
    """
    import sqlalchemy.exc  # as Optuna does, for data bases only

    # When a connection fails, its pool logs a traceback besides raising an exception.
    logging.getLogger('sqlalchemy.pool').setLevel(logging.CRITICAL)
    for _ in range(ATTEMPTS):
        try:
            return RDBStorage(url)
        except sqlalchemy.exc.DBAPIError as error:
            exists = isinstance(error, sqlalchemy.exc.IntegrityError)
            if not exists and 'already exists' not in str(error):
                raise
        time.sleep(PAUSE)
    return RDBStorage(url)


def _open_journal(path: Path) -> BaseStorage:
    if path.exists():
        _expect_records(path)
    return JournalStorage(JournalFileBackend(str(path), _FileLock(path)))


def _expect_records(path: Path) -> None:
    """Raise ConfigurationError, with its number, for the first line that is not a record."""
    with path.open('rb') as file:
        for number, line in enumerate(file, start=1):
            if not line.endswith(b'\n'):
                return  # the last one, cut short by a kill: see `_FileLock`
            try:
                whole = 'op_code' in json.loads(line)
            except (ValueError, TypeError):
                whole = False
            if not whole:
                raise ConfigurationError(
                    f'storage {path}: line {number}: expected a record of an Optuna journal, got '
                    f'{line[:40]!r}'
                )


class _FileLock:
    """
    A lock that the operating system releases when its process is killed.

    Optuna's own locks stay locked then, and every other process waits for half a minute. A killed
    process may also leave an unfinished line, to which the next record would be appended: whoever
    gets the lock removes such a line.
    """

    def __init__(self, journal: Path) -> None:
        self._journal = journal
        self._lock = journal.with_name(journal.name + '.lock')

    def acquire(self) -> bool:
        """Wait for the lock."""
        self._file = self._lock.open('ab')
        fcntl.flock(self._file, fcntl.LOCK_EX)
        with self._journal.open('rb+') as file:
            size = file.seek(0, os.SEEK_END)
            if size:
                file.seek(size - 1)
                if file.read(1) != b'\n':
                    file.seek(0)
                    file.truncate(file.read().rfind(b'\n') + 1)
        return True

    def release(self) -> None:
        """Release the lock."""
        self._file.close()
