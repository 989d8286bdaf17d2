# SPDX-License-Identifier: Apache-2.0
"""
Compiling with numba, and where the machine code is kept between starts.

numba compares only the time of the file that holds a function, not of the files whose functions
it calls, so a changed callee would go unnoticed. Here the folder's name is a digest of all sources
of the core, which are all that a compiled function can call. The folder lies in the user's cache,
because an installed package may be read-only.

numba 0.68 raises what reading a damaged cache file raises (UnpicklingError, EOFError, ...), and an
OSError where a file cannot be written: after a full disk or a power cut no process would start any
more. Here the files have checksums, and an error of the cache means that the function is compiled.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import cache
import hashlib
import logging
import os
from pathlib import Path
import pickle
import shutil
import stat
import tempfile
import threading
import time
from typing import Any, TypeVar

import numba
from numba.core import caching
from numba.core.ccallback import CFunc

Function = TypeVar('Function', bound=Callable[..., Any])
Value = TypeVar('Value')

_numba: Any = caching

CORE = Path(__file__).resolve().parents[1]
NUMPY_ERRORS = {'error_model': 'numpy'}
KEPT = 4
"""Folders of other versions that stay."""
UNUSED = 86_400.0
"""Seconds after which a folder counts as no longer in use."""
NAME = 'fhaosmo_ros'
COMPILE_TIME = '20 s to 3 minutes'
COMPILING = f'compiling the numerical core, once; this takes {COMPILE_TIME} ...'
CHECKSUM = 32
"""Bytes of a checksum."""

logger = logging.getLogger(NAME)
compiling = threading.Event()
"""Set whenever a function has to be compiled."""


def compiled(**options: Any) -> Callable[[Function], Function]:
    """
    Return a decorator that compiles a function with numba and caches its machine code.

    Division by zero gives infinity or NaN, as in numpy, and raises nothing.

    Parameters
    ----------
    **options
        Further options of `numba.njit`, such as ``forceinline=True`` or ``nogil=True``.

    """

    def decorate(function: Function) -> Function:
        decorator: Any = numba.njit(error_model='numpy', **options)
        dispatcher = decorator(function)
        folder = cache_folder()
        if folder is not None:
            dispatcher._cache = _cache_in(folder, function) or dispatcher._cache
        return dispatcher  # type: ignore[no-any-return]

    return decorate


def compiled_callback(function: Callable[..., Any], signature: Any) -> int:
    """
    Return the address of a function's machine code, from the cache if it is there.

    Callers do not contain its code, unlike that of `compiled` functions, so that it costs those
    nothing who never call it.

    Parameters
    ----------
    function : callable
        Calls compiled functions only.
    signature : numba signature
        Of integers and floats.

    """
    callback: Any = CFunc(function, (signature.args, signature.return_type), {}, NUMPY_ERRORS)
    folder = cache_folder()
    if folder is not None:
        callback._cache = _cache_in(folder, function) or callback._cache
    callback.compile()
    return int(callback.address)


class MachineCode(_numba.FunctionCache):  # type: ignore[misc]
    """numba's cache of one function, in which every error is a miss that is logged."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = CheckedFiles(self._cache_path, self._impl.filename_base, stamp)
        self._is_core = function.__module__.startswith('fhaosmo_ros.core.')

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled function, or None if it has to be compiled."""
        found = None
        try:
            found = super().load_overload(signature, context)
        except Exception as error:
            self._remove()
            _warn(f'thrown away a damaged compile cache in {self._cache_path} ({_text(error)})')
        if found is None:
            if self._is_core:  # what tools compile takes a second
                _say_that_it_compiles()
            compiling.set()
        return found

    def save_overload(self, signature: Any, result: Any) -> None:
        """Save a compiled function if possible."""
        try:
            super().save_overload(signature, result)
        except Exception as error:
            self._remove()
            _warn(
                f'cannot keep compiled code in {self._cache_path} ({_text(error)}): it is '
                'compiled again at the next start'
            )

    def _remove(self) -> None:
        """Remove the function's files, as far as that is possible."""
        for path in Path(self._cache_path).glob(f'{self._impl.filename_base}.*'):
            with suppress(OSError):
                path.unlink()


class CheckedFiles(_numba.IndexDataCacheFile):  # type: ignore[misc]
    """numba's files of one function, each behind its checksum; numba replaces them whole."""

    def _dump(self, content: Any) -> bytes:
        return _with_checksum(super()._dump(content))

    def _save_index(self, overloads: dict[Any, str]) -> None:
        with self._open_for_write(self._index_path) as file:
            file.write(self._dump((self._source_stamp, overloads)))

    def _load_index(self) -> dict[Any, str]:
        try:
            stamp, overloads = _load(self._index_path)
        except FileNotFoundError:
            return {}
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        return _load(self._data_path(name))


def kept(name: str, make: Callable[[], Value]) -> Value:
    """
    Return what an earlier process has made and kept beside the machine code, or make and keep it.

    Parameters
    ----------
    name : str
        Of the file.
    make : callable
        Returns the value, which depends on `name` and the core's sources only.

    """
    folder = cache_folder()
    if folder is None:
        return make()
    path = folder / name
    try:
        return _load(path)  # type: ignore[no-any-return]
    except FileNotFoundError:
        pass
    except Exception as error:
        _warn(f'thrown away a damaged file {path} ({_text(error)})')
    value = make()
    beside = path.with_name(f'{name}.{os.getpid()}.tmp')
    try:
        beside.write_bytes(_with_checksum(pickle.dumps(value)))
        beside.replace(path)
    except OSError as error:
        with suppress(OSError):
            beside.unlink()
        _warn(f'cannot keep {path} ({_text(error)}): it is computed again at the next start')
    return value


def _with_checksum(data: bytes) -> bytes:
    return hashlib.sha256(data).digest() + data


def _load(path: str | Path) -> Any:
    """
    Return the content of a file that begins with its checksum.

    Raises
    ------
    ValueError
        The checksum is wrong.

    """
    content = Path(path).read_bytes()
    data = content[CHECKSUM:]
    if hashlib.sha256(data).digest() != content[:CHECKSUM]:
        raise ValueError('wrong checksum')
    return pickle.loads(data)  # noqa: S301 - in a folder of the user's own


def _cache_in(folder: Path, function: Any) -> MachineCode | None:
    settings: Any = numba.config  # its attributes are made at run time
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(folder)  # read while the cache is made
    try:
        return MachineCode(function)
    except Exception as error:
        _warn(f'cannot keep compiled code in {folder} ({_text(error)})')
        return None
    finally:
        settings.CACHE_DIR = before


@cache
def _say_that_it_compiles() -> None:
    logger.warning(COMPILING)


_warned: list[str] = []


def _warn(text: str) -> None:
    """Log what is wrong with the cache: once in a process, not for each function."""
    if not _warned:
        logger.warning(text)
    _warned.append(text)


def _text(error: Exception) -> str:
    return ' '.join(f'{type(error).__name__}: {error}'.split())


@cache
def cache_folder() -> Path | None:
    """
    Return the folder of this version of the core, or None if there is no place for it.

    It lies in ``NUMBA_CACHE_DIR`` if that is set, else in the user's cache. Where neither can be
    written, it lies in a folder of the user's own in the temporary folder.
    """
    error: Exception = OSError('no place')
    for find_base in (_usual, _temporary):
        try:
            return _folder_in(find_base())
        except (OSError, RuntimeError) as raised:  # no home, or a read-only one
            error = raised
    _warn(f'no place to keep compiled code ({_text(error)}): each start compiles, {COMPILE_TIME}')
    return None


def _usual() -> Path:
    settings: Any = numba.config
    user_cache = os.environ.get('XDG_CACHE_HOME')
    return Path(settings.CACHE_DIR or user_cache or Path.home() / '.cache') / NAME


def _temporary() -> Path:
    """
    Return the user's own folder in the temporary folder.

    Raises
    ------
    PermissionError
        Somebody else could write there, and so have this process run other code.

    """
    folder = Path(tempfile.gettempdir()) / f'{NAME}_{os.getuid()}'
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
    if not own or stat.S_IMODE(found.st_mode) & 0o077:
        raise PermissionError(f'{folder} must be a folder that only its owner can use')
    return folder


def _folder_in(base: Path) -> Path:
    folder = base / digest_of(CORE)
    folder.mkdir(parents=True, exist_ok=True)
    folder.touch()
    with tempfile.TemporaryFile(dir=folder):
        pass
    _remove_old(base)
    return folder


def digest_of(package: Path) -> str:
    """Return a digest of numba's version and of a package's sources, sub-packages included."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(package.rglob('*.py')):
        digest.update(str(source.relative_to(package)).encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _remove_old(base: Path) -> None:
    by_age = sorted(base.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for old in by_age[KEPT + 1 :]:
        if time.time() - old.stat().st_mtime > UNUSED:
            shutil.rmtree(old, ignore_errors=True)
