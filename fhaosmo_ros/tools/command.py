# SPDX-License-Identifier: Apache-2.0
"""What the commands have in common: arguments, signals, one line for what is wrong, exit codes."""

import argparse
from collections.abc import Callable
import sys

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop, stop_on_signals, Stopped

Body = Callable[[argparse.Namespace, Stop], int | None]


class Interrupted(Exception):
    """The user asked to stop before there was anything to keep; the text says so."""


def run_command(parser: argparse.ArgumentParser, argv: list[str] | None, body: Body) -> int:
    """
    Run a command whose body looks at the event that SIGINT and SIGTERM set.

    Returns
    -------
    int
        What the body returns, 0 for None; 2 for wrong input, or an output that can't be written;
        130 if it was interrupted. The last two are said in one line.

    """
    arguments = parser.parse_args(argv)
    stop = stop_on_signals()
    try:
        return body(arguments, stop) or 0
    except ConfigurationError as error:
        return _say(parser, f'error: {error}', 2)
    except OSError as error:
        place = f': {error.filename}' if error.filename else ''
        return _say(parser, f'error: {error.strerror or error}{place}', 2)
    except (Interrupted, KeyboardInterrupt) as error:
        return _say(parser, f'interrupted{f", {error}" if str(error) else ""}', 130)


def run_computation(
    parser: argparse.ArgumentParser, argv: list[str] | None,
    body: Callable[[argparse.Namespace], int | None],
) -> int:  # fmt: skip
    """Run a command as `run_command` does, whose body the first signal ends wherever it is."""

    def interruptible(arguments: argparse.Namespace, stop: Stop) -> int | None:
        try:
            with stop.raising():
                return body(arguments)
        except Stopped:
            raise Interrupted from None

    return run_command(parser, argv, interruptible)


def _say(parser: argparse.ArgumentParser, text: str, code: int) -> int:
    print(f'{parser.prog}: {text}', file=sys.stderr)
    return code
