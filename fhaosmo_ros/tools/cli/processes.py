# SPDX-License-Identifier: Apache-2.0
"""Child processes that never outlive their parent's block."""

from pathlib import Path
import signal
import subprocess
import sys
from typing import Any, ClassVar

from fhaosmo_ros.core.parameters.errors import ConfigurationError

GRACE = 5.0
"""Seconds that a child has to end by itself."""


class Child(subprocess.Popen[bytes]):
    """
    A Python process whose output goes to a file.

    Parameters
    ----------
    log : path
        Its output.
    arguments : str
        What follows ``python``.
    options
        For `subprocess.Popen`: ``start_new_session=True`` lets Ctrl-C in a terminal reach only
        the parent.

    """

    def __init__(self, log: Path, *arguments: str, **options: Any) -> None:
        self._log = log
        with log.open('wb') as output:
            super().__init__(
                [sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=output,
                stderr=subprocess.STDOUT, **options,
            )  # fmt: skip

    def output(self) -> str:
        """Return what the child has printed so far."""
        return self._log.read_text(errors='replace')

    def check(self) -> None:
        """Raise, with the end of its output, if the child has ended."""
        if self.poll() is not None:
            last = ' / '.join(self.output().splitlines()[-2:])
            raise ConfigurationError(
                f'{self._log.stem} ended with exit code {self.returncode}: '
                f'{last or "without a word"}'
            )

    def interrupt(self) -> None:
        """Ask the child to end."""
        self.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Wait for the child's end, and kill it if it takes more than `GRACE` seconds."""
        try:
            self.wait(GRACE)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()


class Children:
    """
    Children that all end with its block.

    Parameters
    ----------
    folder : path
        Each child's output goes to ``<name>.log`` there.

    """

    kind: ClassVar[type[Child]] = Child

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._children: list[Child] = []

    def start(self, name: str, *arguments: str, **options: Any) -> Any:
        """Start a child; see `Child`."""
        child = self.kind(self._folder / f'{name}.log', *arguments, **options)
        self._children.append(child)
        return child

    def start_node(self, name: str, *arguments: str) -> Child:
        """Start one of this package's nodes."""
        return self.start(name, '-m', 'fhaosmo_ros', name, *arguments)

    def check(self) -> None:
        """Raise if one of them has ended."""
        for child in self._children:
            child.check()

    def __enter__(self) -> 'Children':
        return self

    def __exit__(self, *_: object) -> None:
        # A second Ctrl-C does not cut this short: a command's handlers of signals raise nothing.
        for child in self._children:
            child.interrupt()
        for child in self._children:
            child.end()
