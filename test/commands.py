# SPDX-License-Identifier: Apache-2.0
"""The package's commands as processes of their own, as users start them."""

import contextlib
import fcntl
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

# Of ROS: ids up to 101 keep clear of Linux' ephemeral ports; those below 20 are the benchmarks'.
DOMAINS = range(20, 102)
_locks = []
ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, '-m', 'fhaosmo_ros']


def take_domain() -> int:
    """Return a domain that no other test process of this machine has; held until the end."""
    for number in DOMAINS:
        path = Path(tempfile.gettempdir()) / f'fhaosmo_ros_test_domain_{number}.lock'
        _locks.append(path.open('w'))
        with contextlib.suppress(OSError):  # taken
            fcntl.flock(_locks[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
            return number
    raise RuntimeError(f'all ROS domains {DOMAINS} are taken by test processes')


def environment(**changes):
    path = os.pathsep.join([str(ROOT), *sys.path])
    return {**os.environ, 'PYTHONPATH': path, **changes}


def start(*arguments, command=COMMAND, **options):
    """Start a command, or Python, in a session of its own: no Ctrl-C for the tests reaches it."""
    options = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE} | options
    return subprocess.Popen(
        [*command, *map(str, arguments)], text=True, start_new_session=True,
        **{'env': environment()} | options,
    )  # fmt: skip


def run(*arguments, command=COMMAND, **options):
    """Run a command, or another program, to its end."""
    return subprocess.run(
        [*command, *map(str, arguments)], capture_output=True, text=True, check=False,
        **{'env': environment(), 'timeout': 400} | options,
    )  # fmt: skip


def wait_until(condition, what, seconds=60.0, process=None, pause=0.01):
    """Return what `condition` gives once that is true, soon enough and while `process` runs."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        if time.monotonic() > deadline:
            raise TimeoutError(f'no {what} within {seconds:g} s')
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(pause)
    return found
