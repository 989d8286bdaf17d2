# SPDX-License-Identifier: Apache-2.0
"""Run one of the package's commands: `python -m fhaosmo_ros COMMAND [ARGUMENTS]`."""

from collections.abc import Callable
import difflib
from functools import partial
import importlib
import os
import signal
import sys

from fhaosmo_ros.commands import COMMANDS


def usage() -> str:
    """Return the help text: one line for each command."""
    lines = [f'  {name:<10} {text}' for name, (_, text) in COMMANDS.items()]
    return '\n'.join(['usage: python -m fhaosmo_ros COMMAND [ARGUMENTS]', '', *lines])


def main(argv: list[str] | None = None) -> int:
    """Run the command that `argv` names and return its exit code (2: no such command)."""
    arguments = sys.argv[1:] if argv is None else argv
    if not arguments:
        print(usage(), file=sys.stderr)
        return 2
    name, *rest = arguments
    if name in ('-h', '--help'):
        print(usage())
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f'; did you mean {close[0]!r}?' if close else ''
        known = ', '.join(COMMANDS)
        print(f'error: no command {name!r} (commands: {known}){hint}', file=sys.stderr)
        return 2
    return run(name, rest)


def run(name: str, arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code."""
    if COMMANDS[name][0].startswith('fhaosmo_ros.nodes.'):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: os._exit(0))  # while it loads nothing has begun
    # Imported only now: a node needs ROS, and the help must not wait for numba.
    try:
        module = importlib.import_module(COMMANDS[name][0])
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith('fhaosmo_ros'):
            raise
        print(
            f'error: {name!r} needs the Python module {error.name!r}, which is not installed: '
            'start it through make, or source a ROS 2 Jazzy first (see README)',
            file=sys.stderr,
        )
        return 1
    except KeyboardInterrupt:  # while it loads; later the command itself sees to signals
        return 130
    return int(module.main(arguments))


def __getattr__(name: str) -> Callable[[], int]:
    """Return the function that runs a command: the entry points of `ros2 run`."""
    if name not in COMMANDS:
        raise AttributeError(name)
    return partial(run, name)


if __name__ == '__main__':
    sys.exit(main())
