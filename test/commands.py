# SPDX-License-Identifier: Apache-2.0
"""The package's commands as processes of their own, as users start them."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, '-m', 'fhaosmo_ros']


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


def run(*arguments):
    """Run a command to its end."""
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=400,
        env=environment(), check=False,
    )  # fmt: skip


def interrupted(process):
    """Press Ctrl-C, and return what the command, which has to end well, has said."""
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60)
    assert process.returncode == 0, (out, error)
    return out, error


def wait_until(condition, what, seconds=60.0, process=None):
    """Wait until `condition` holds, at most so many seconds and while the `process` runs."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f'no {what} within {seconds:g} s')
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.01)
