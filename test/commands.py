# SPDX-License-Identifier: Apache-2.0
"""The package's commands as processes of their own, as users start them."""

import os
from pathlib import Path
import signal
import subprocess
import sys

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
