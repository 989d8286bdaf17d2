# SPDX-License-Identifier: Apache-2.0
"""What all commands share: options, signals, one-line errors, exit codes, output, progress."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
import os
from pathlib import Path
import re
import shlex
import sys
from tempfile import TemporaryDirectory
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.yaml_text import parse_rule
from fhaosmo_ros.stop_signals import Stop, stop_on_signals, Stopped
from tqdm import tqdm

Body = Callable[[argparse.Namespace, Stop], int | None]
progress = partial(tqdm, disable=None)
"""A bar in a terminal, and nothing in a log."""


def run_command(parser: argparse.ArgumentParser, argv: Sequence[str] | None, body: Body) -> int:
    """
    Run a command with what follows its name (by default ``sys.argv[1:]``); return its exit code.

    That is what the body returns, 0 for None; 2 for wrong input, or an output that cannot be
    written; 130 if it was interrupted. Each but the first is said in one line.

    SIGINT, SIGTERM and SIGHUP do the same: they set the event `stop` that the body gets, also in a
    process that was started with SIGINT ignored, as a shell without job control starts its
    background jobs. A body waits with ``stop.wait()`` and raises `Stopped`; or it computes
    ``with stop.raising():``, which raises it. Either way its context managers end: no child
    process and no half of an output stays behind.

    The body also gets the arguments. ``arguments.command_line`` is what was typed, without the
    passwords in URLs, as outputs keep it; ``arguments.ros_arguments`` is the part of it between
    ``--ros-args`` and ``--`` or the end, which a launch file adds to every program.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    if '--version' in given:
        parser.exit(0, f'fhaosmo_ros {__version__}\n')
    own, of_ros = given, []
    if '--ros-args' in given:
        begin = given.index('--ros-args')
        end = given.index('--', begin) if '--' in given[begin:] else len(given)
        own, of_ros = given[:begin] + given[end + 1 :], given[begin + 1 : end]
    arguments = parser.parse_args(own)
    arguments.ros_arguments = of_ros
    arguments.command_line = without_password(shlex.join([parser.prog, *given]))
    stop = stop_on_signals()
    try:
        return body(arguments, stop) or 0
    except ConfigurationError as error:
        text, code = f'error: {error}', 2
    except OSError as error:
        place = f': {error.filename}' if error.filename else ''
        text, code = f'error: {error.strerror or error}{place}', 2
    except Stopped as error:
        text, code = f'interrupted{f", {error}" if str(error) else ""}', 130
    print(f'{parser.prog}: {without_password(text)}', file=sys.stderr)
    return code


def without_password(text: str) -> str:
    """Return a text with ``***`` in place of the password of each URL in it."""
    return re.sub(r'(://[^:/@\s]*:)\S*@', r'\1***@', text)


def add_value_options(parser: argparse.ArgumentParser, which: str) -> None:
    """Add --params-file, whose help says `which` parameters, and -p."""
    parser.add_argument(
        '--params-file', type=Path, action='append', default=[], metavar='FILE', help=which
    )
    parser.add_argument(
        '-p', '--param', action='append', default=[], metavar='NAME:=VALUE',
        help='set one parameter; wins over files, and over a bag',
    )  # fmt: skip


def values_of(rules: Sequence[str]) -> dict[str, Any]:
    """Return the values that rules NAME:=VALUE set."""
    return dict(map(parse_rule, rules))


@contextmanager
def output_at(final: Path, force: bool = False, *inputs: Path) -> Iterator[Path]:
    """
    Yield where to write a file or folder meanwhile, and move it to its place once complete.

    It is complete when the block ends without an error; else nothing stays, and what was there
    before does; but a kill leaves the folder NAME.*.part beside the place. The path that is
    yielded has the final name, in that folder, and does not exist yet. ConfigurationError if the
    place is in use, unless `force`: by a file, or a folder that is not empty; `force` or not, by
    one of the inputs, or a part of one.
    """
    if final.name in ('', '..'):  # nothing could be renamed to it
        raise ConfigurationError(f'output {final}: expected a name, got a folder that is in use')
    place = final.resolve()
    for path in map(Path.resolve, inputs):
        if place in (path, *path.parents) or (path in place.parents and place.exists()):
            raise ConfigurationError(
                f'output {final}: expected another place than the input has, got that of {path}'
            )

    def expect_free() -> None:
        empty = not final.exists() or (final.is_dir() and not any(final.iterdir()))
        if not (empty or force):
            raise ConfigurationError(
                f'output {final}: expected a new name (or --force to replace it), got an existing '
                f'{"folder with something in it" if final.is_dir() else "file"}'
            )

    expect_free()
    final.parent.mkdir(parents=True, exist_ok=True)
    folder = TemporaryDirectory(
        prefix=f'{final.name}.', suffix='.part', dir=final.parent, ignore_cleanup_errors=True
    )
    with folder as name:
        written = Path(name, final.name)
        try:
            yield written
            expect_free()  # another process may have been quicker
            if final.exists():
                final.rename(Path(name, 'replaced'))
            written.rename(final)
        except OSError as error:
            if error.filename is None:  # of a write, such as to a disk that is full
                text = error.strerror or str(error)
                raise OSError(error.errno, text, str(final)) from None
            raise


def shipped(relative: str) -> Path:
    """
    Return the path of a shipped file, such as 'config/demo.yaml'.

    It looks beside the sources (a checkout, colcon build --symlink-install), then in the
    prefixes of a sourced workspace, then in the Python environment (pip install).
    """
    prefixes = filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
    places = [Path(__file__).resolve().parents[3]]
    places += [Path(prefix, 'share', 'fhaosmo_ros') for prefix in (*prefixes, sys.prefix)]
    for place in places:
        if (place / relative).is_file():
            return place / relative
    raise ConfigurationError(
        f'{relative}: expected it in one of {", ".join(map(str, places))}, found it in none'
    )
