# SPDX-License-Identifier: Apache-2.0
"""
Run one of the package's commands.

`python -m fhaosmo_ros COMMAND [ARGUMENTS]` in a checkout, `fhaosmo COMMAND [ARGUMENTS]` after pip
install, `ros2 run fhaosmo_ros COMMAND [ARGUMENTS]` in a workspace.
"""

from collections.abc import Callable
from functools import cache, partial
import gc
import importlib
import os
from pathlib import Path
import signal
import sys
import warnings

from fhaosmo_ros import __version__
from fhaosmo_ros.commands import COMMANDS
from fhaosmo_ros.stop_signals import ending_signals


def usage() -> str:
    """Return the help text: one line for each command."""
    program = 'fhaosmo' if Path(sys.argv[0]).name == 'fhaosmo' else 'python -m fhaosmo_ros'
    lines = [f'  {name:<11} {text}' for name, (_, text) in COMMANDS.items()]
    return '\n'.join([f'usage: {program} COMMAND [ARGUMENTS]', '', *lines])


def main(argv: list[str] | None = None) -> int:
    """Run the command that `argv` names and return its exit code (2: no such command)."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ['']
    if name in COMMANDS:
        return run(name, rest)
    if name in ('-h', '--help', '--version'):
        print(f'fhaosmo_ros {__version__}' if name == '--version' else usage())
        return 0
    unknown = f'error: no command {name!r} (commands: {", ".join(COMMANDS)})'
    print(unknown if name else usage(), file=sys.stderr)
    return 2


def run(name: str, arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code."""
    # While it loads, nothing has begun. These handlers also end a process that was started with
    # SIGINT ignored; the command sets its own.
    code = 0 if COMMANDS[name][0].startswith('.nodes.') else 130
    for number in ending_signals():
        signal.signal(number, lambda *_: os._exit(code))
    tell = cache(lambda text: print(f'{name}: warning: {text}', file=sys.stderr))
    warnings.showwarning = lambda text, *_: tell(str(text))  # once, without a path in the package
    try:
        # Imported only now: a node needs ROS, and the help must not wait for numpy.
        gc.disable()  # nearly all that an import makes stays; looking for garbage takes 0.1 s
        module = importlib.import_module(COMMANDS[name][0], 'fhaosmo_ros')
        gc.freeze()
        gc.enable()
        return int(module.main(arguments))
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith('fhaosmo_ros'):
            raise
        print(
            f'error: {name!r} needs the Python module {error.name!r}, which is not installed: '
            'start it through make, or source a ROS 2 Jazzy first (see docs/start.md)',
            file=sys.stderr,
        )
        return 1


def __getattr__(name: str) -> Callable[[], int]:
    """Return the function that runs a command: the entry points of `ros2 run`."""
    if name not in COMMANDS:
        raise AttributeError(name)
    return partial(run, name)


if __name__ == '__main__':
    sys.exit(main())
