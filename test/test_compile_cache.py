# SPDX-License-Identifier: Apache-2.0
"""Compiled functions are cached in the package's folder, and never outlive a change."""

import os
from pathlib import Path
import shutil
import subprocess
import sys

import bag_files as files
import fhaosmo_ros.core
from fhaosmo_ros.core.compiled import cache
from fhaosmo_ros.core.compiled.cache import COMPILING
import numpy as np
import pytest

CORE = Path(fhaosmo_ros.core.__file__).parent
MODULES = [
    'fhaosmo_ros.core.' + '.'.join(path.relative_to(CORE).with_suffix('').parts)
    for path in CORE.rglob('*.py')
    if path.stem != '__init__'
]
PRINT_FOLDERS = f"""
from importlib import import_module
for name in {MODULES!r}:
    for value in vars(import_module(name)).values():
        if hasattr(value, 'py_func') and value._cache.cache_path:  # intrinsics have none
            print(value._cache.cache_path)
"""
CALLER = """
from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.callee import callee

@compiled()
def caller(x):
    return callee(x) + 1.0
"""
CALLEE = """
from fhaosmo_ros.core.compiled.cache import compiled

@compiled()
def callee(x):
    return {factor} * x
"""


CALL = (
    'from fhaosmo_ros.core.simulation.caller import caller\n'
    'print(caller(3.0), len(caller.stats.cache_hits), len(caller.stats.cache_misses))'
)
DAMAGES = {
    'empty': lambda data: b'',
    'truncated': lambda data: data[: len(data) // 2],
    'zeroed': lambda data: bytes(len(data)),
    'garbage': lambda data: np.random.default_rng(1).bytes(len(data)),
    'one bit': lambda data: data[:-20] + bytes([data[-20] ^ 1]) + data[-19:],
}


def run_both(code, cwd=None, **variables):
    """Run Python code; return the words on stdout, and the lines on stderr."""
    environment = {k: v for k, v in os.environ.items() if k != 'NUMBA_CACHE_DIR'}
    done = subprocess.run(
        [sys.executable, '-c', code],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=environment | {k: str(v) for k, v in variables.items()},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split(), done.stderr.splitlines()


def run(code, cwd=None, **variables):
    return run_both(code, cwd, **variables)[0]


def test_no_compiled_function_is_cached_elsewhere(tmp_path):
    folders = {Path(line).parent for line in run(PRINT_FOLDERS, XDG_CACHE_HOME=tmp_path)}
    assert len(folders) == 1
    assert tmp_path in folders.pop().parents
    assert 'fhaosmo_ros.core.online.policy' in MODULES


def small_package(folder, factor):
    """Write a package of the same name with the real cache and two functions in two rooms."""
    core = folder / 'fhaosmo_ros' / 'core'
    for room in ('compiled', 'model', 'simulation'):
        (core / room).mkdir(parents=True, exist_ok=True)
        (core / room / '__init__.py').touch()
    for package in (core, core.parent):
        (package / '__init__.py').touch()
    shutil.copy(CORE / 'compiled' / 'cache.py', core / 'compiled')
    (core / 'simulation' / 'caller.py').write_text(CALLER)
    (core / 'model' / 'callee.py').write_text(CALLEE.format(factor=factor))


def test_caller_is_compiled_anew_when_a_callee_in_another_room_changes(tmp_path):
    """Also with NUMBA_CACHE_DIR, where numba's own cache would keep the old machine code."""
    for variable in ('XDG_CACHE_HOME', 'NUMBA_CACHE_DIR'):
        places = {'PYTHONPATH': tmp_path / variable, variable: tmp_path / variable / 'cache'}
        small_package(tmp_path / variable, factor=2.0)
        assert run(CALL, tmp_path, **places) == ['7.0', '0', '1']
        assert run(CALL, tmp_path, **places) == ['7.0', '1', '0']
        small_package(tmp_path / variable, factor=5.0)
        assert run(CALL, tmp_path, **places) == ['16.0', '0', '1']


@pytest.fixture(scope='module')
def warm(tmp_path_factory):
    """Return a folder with a small package and its filled cache."""
    folder = tmp_path_factory.mktemp('warm')
    small_package(folder, factor=2.0)
    said = run_both(CALL, folder, PYTHONPATH=folder, NUMBA_CACHE_DIR=folder / 'cache')
    assert said == (['7.0', '0', '1'], [COMPILING])
    return folder


@pytest.mark.parametrize('damage', DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_cache_is_thrown_away_and_made_anew(warm, tmp_path, damage):
    places = {'PYTHONPATH': warm, 'NUMBA_CACHE_DIR': tmp_path}
    shutil.copytree(warm / 'cache', tmp_path, dirs_exist_ok=True)
    for pattern in ('*.nbi', '*.nbc'):  # indices; machine code
        for path in tmp_path.rglob(pattern):
            path.write_bytes(damage(path.read_bytes()))
        words, (thrown_away, compiling) = run_both(CALL, warm, **places)
        assert words == ['7.0', '0', '1']
        assert thrown_away.startswith('thrown away a damaged compile cache')
        assert compiling == COMPILING
    assert run_both(CALL, warm, **places) == (['7.0', '1', '0'], [])


FULL_DISK = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))  # writing more fails, as on a full disk
"""


def test_a_full_disk_is_said_once_and_nothing_half_is_left(warm, tmp_path):
    places = {'PYTHONPATH': warm, 'NUMBA_CACHE_DIR': tmp_path}
    words, (compiling, cannot) = run_both(FULL_DISK + CALL, warm, **places)
    assert words == ['7.0', '0', '1']
    assert compiling == COMPILING
    assert cannot.startswith('cannot keep compiled code')
    assert not [path for path in tmp_path.rglob('*') if path.is_file()]


def test_an_unwritable_home_uses_one_folder_of_the_user(warm, tmp_path):
    (tmp_path / 'file').touch()
    places = {'PYTHONPATH': warm, 'XDG_CACHE_HOME': tmp_path / 'file', 'TMPDIR': tmp_path}
    assert run(CALL, warm, **places) == ['7.0', '0', '1']
    assert run(CALL, warm, **places) == ['7.0', '1', '0']
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)  # somebody else could put code there
    words, (no_place,) = run_both(CALL, warm, **places)
    assert words[0] == '7.0'
    assert no_place.startswith('no place to keep compiled code')


def test_kept_values_survive_a_process_and_damage(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, 'cache_folder', lambda: tmp_path)
    assert cache.kept('square', lambda: [4.0]) == [4.0]
    assert cache.kept('square', lambda: pytest.fail('made again')) == [4.0]
    for damage in DAMAGES.values():
        path = tmp_path / 'square'
        path.write_bytes(damage(path.read_bytes()))
        assert cache.kept('square', lambda: [9.0]) == [9.0]
        assert cache.kept('square', lambda: pytest.fail('made again')) == [9.0]
    (tmp_path / 'square').unlink()
    monkeypatch.setattr(cache, 'cache_folder', lambda: None)
    assert cache.kept('square', lambda: [4.0]) == [4.0]
    assert not list(tmp_path.iterdir())


def test_compile_leaves_nothing_for_the_first_start(tmp_path):
    bag = files.write(tmp_path / 'bag', files.floats(*files.signal(50)))
    places = {'PYTHONPATH': os.pathsep.join([str(CORE.parents[1]), *sys.path])}
    main = 'from fhaosmo_ros.__main__ import main; raise SystemExit(main({!r}))'
    words, _ = run_both(main.format(['compile']), tmp_path, **places)
    assert words[:2] == ['compiled', 'in']
    _, said = run_both(main.format(['replay', str(bag)]), tmp_path, **places)
    assert COMPILING not in said
