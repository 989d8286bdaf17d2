# SPDX-License-Identifier: Apache-2.0
"""
Where numba keeps the compiled core between starts.

numba compares only the time of the file that holds a function, not of the files whose functions
it calls, so a changed callee would go unnoticed. Here the folder's name is a digest of all the
core's sources. It lies in the user's cache, because an installed package may be read-only.
"""

from collections.abc import Iterator
from contextlib import contextmanager
import hashlib
import os
from pathlib import Path
import shutil
import tempfile
import time
from typing import Any

import numba

KEPT = 4
"""Folders of other versions that stay."""
UNUSED = 86_400.0
"""Seconds after which nobody writes to a folder any more."""


@contextmanager
def compile_cache() -> Iterator[None]:
    """
    Let functions that are decorated meanwhile keep their machine code in our folder.

    ``NUMBA_CACHE_DIR``, where it is set, wins.
    """
    settings: Any = numba.config  # its attributes are made at run time
    before = settings.CACHE_DIR
    if not before:
        settings.CACHE_DIR = str(_folder())
    try:
        yield
    finally:
        settings.CACHE_DIR = before


def _folder() -> Path:
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.glob('*.py')):
        digest.update(source.read_bytes())
    try:
        home = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
        base = Path(home) / 'fhaosmo_ros'
        folder = base / digest.hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        folder.touch()
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):  # no home, or a read-only one
        return Path(tempfile.mkdtemp(prefix='fhaosmo_ros_'))
    by_age = sorted(base.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for old in by_age[KEPT + 1 :]:
        if time.time() - old.stat().st_mtime > UNUSED:
            shutil.rmtree(old, ignore_errors=True)
    return folder
