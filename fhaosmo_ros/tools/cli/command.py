# SPDX-License-Identifier: Apache-2.0
"""The one way in which a command runs: arguments, signals, one-line errors, exit codes."""

import argparse
from collections.abc import Callable, Sequence
from importlib.util import find_spec
import re
import shlex
import sys

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop, stop_on_signals, Stopped

Body = Callable[[argparse.Namespace, Stop], int | None]


class Interrupted(Exception):
    """Raised where a command gives up because of a signal; its text says what was written."""


def run_command(
    parser: argparse.ArgumentParser,
    argv: Sequence[str] | None,
    body: Body,
    needs: Sequence[str] = (),
) -> int:
    """
    Run a command.

    SIGINT, SIGTERM and SIGHUP do the same: they set the event `stop` that the body gets, also in a
    process that was started with SIGINT ignored, as a shell without job control starts its
    background jobs. A body asks ``stop.is_set()`` or waits with ``stop.wait()``, and raises
    `Interrupted`; or it computes ``with stop.raising():``, which raises `Stopped`. Either way its
    context managers end: no child process and no half of an output stays behind.

    Parameters
    ----------
    parser : ArgumentParser
        Its ``prog`` is the command's name.
    argv : sequence of str or None
        What follows the command's name; ``sys.argv[1:]`` by default.
    body : callable
        Gets the parsed arguments and the event. ``arguments.command_line`` is what was typed,
        without the passwords in URLs, as outputs keep it; ``arguments.ros_arguments`` is the
        part of it between ``--ros-args`` and ``--``, which a launch file adds to every program.
    needs : sequence of str, optional
        Requirements, as for pip, that only this command has: a robot may lack them. The body
        imports them.

    Returns
    -------
    int
        What the body returns, 0 for None; 1 if a requirement is not installed; 2 for wrong input,
        or an output that cannot be written; 130 if it was interrupted. Each but the first is said
        in one line.

    """
    given = sys.argv[1:] if argv is None else argv
    if '--version' in given:
        parser.exit(0, f'fhaosmo_ros {__version__}\n')
    own, ros_arguments = split_ros_arguments(given)
    arguments = parser.parse_args(own)
    arguments.ros_arguments = ros_arguments
    arguments.command_line = without_password(shlex.join([parser.prog, *given]))
    stop = stop_on_signals()
    modules = [re.split(r'\W', need)[0] for need in needs]
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        how = f'make {parser.prog} does it, or python3 -m pip install {shlex.join(needs)}'
        return _say(parser, f'error: {" and ".join(missing)} not installed: {how}', 1)
    try:
        return body(arguments, stop) or 0
    except ConfigurationError as error:
        return _say(parser, f'error: {error}', 2)
    except OSError as error:
        place = f': {error.filename}' if error.filename else ''
        return _say(parser, f'error: {error.strerror or error}{place}', 2)
    except (Interrupted, Stopped, KeyboardInterrupt) as error:  # the last by a window's toolkit
        return _say(parser, f'interrupted{f", {error}" if str(error) else ""}', 130)


def without_password(text: str) -> str:
    """Return a text with ``***`` in place of the password of each URL in it."""
    return re.sub(r'(://[^:/@\s]*:)\S*@', r'\1***@', text)


def split_ros_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a command's own arguments, and those between ``--ros-args`` and ``--`` or the end."""
    own: list[str] = []
    of_ros: list[str] = []
    target = own
    for word in argv:
        if word == '--ros-args':
            target = of_ros
        elif word == '--' and target is of_ros:
            target = own
        else:
            target.append(word)
    return own, of_ros


def _say(parser: argparse.ArgumentParser, text: str, code: int) -> int:
    print(f'{parser.prog}: {without_password(text)}', file=sys.stderr)
    return code
