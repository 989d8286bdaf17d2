# SPDX-License-Identifier: Apache-2.0
"""Every compiled function of the core keeps its machine code in the package's own folder."""

import os
from pathlib import Path
import subprocess
import sys

import fhaosmo_ros.core

FILES = Path(fhaosmo_ros.core.__file__).parent.glob('*.py')
MODULES = [f'fhaosmo_ros.core.{path.stem}' for path in FILES if path.stem != '__init__']
PRINT_FOLDERS = f"""
from importlib import import_module
import fhaosmo_ros.core
for name in {MODULES!r}:
    for value in vars(import_module(name)).values():
        if hasattr(value, 'py_func') and value._cache.cache_path:  # intrinsics have none
            print(value._cache.cache_path)
"""


def test_no_compiled_function_is_cached_elsewhere(tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != 'NUMBA_CACHE_DIR'}
    done = subprocess.run(
        [sys.executable, '-c', PRINT_FOLDERS], capture_output=True, text=True, check=True,
        env=environment | {'XDG_CACHE_HOME': str(tmp_path)},
    )  # fmt: skip
    folders = {Path(line).parent for line in done.stdout.split()}
    assert len(folders) == 1
    assert tmp_path in folders.pop().parents
    assert 'fhaosmo_ros.core.policy' in MODULES
