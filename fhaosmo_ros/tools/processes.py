# SPDX-License-Identifier: Apache-2.0
"""Child processes that never outlive their parent's block."""

import os
from pathlib import Path
import signal
import subprocess
import sys
from types import TracebackType
from typing import Any, ClassVar

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.stop_signals import SIGNALS

GRACE = 5.0
"""Seconds that a child has to end by itself."""


class Child:
    """
    A Python process whose output goes to a file.

    Parameters
    ----------
    log : path
        Its output.
    arguments : str
        What follows ``python``.
    environment : dict, optional
        Variables to add.
    apart : bool
        In a session of its own: Ctrl-C in a terminal then reaches only the parent.
    cwd : path, optional
        Where it works.

    """

    failure: ClassVar[type[Exception]] = ConfigurationError
    """What `check` raises."""

    def __init__(
        self, log: Path, *arguments: str, environment: dict[str, str] | None = None,
        apart: bool = False, cwd: Path | None = None,
    ) -> None:  # fmt: skip
        self._log = log
        with log.open('wb') as output:
            self._process = subprocess.Popen(
                [sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=output,
                stderr=subprocess.STDOUT, start_new_session=apart, cwd=cwd,
                env={**os.environ, **(environment or {})},
            )  # fmt: skip
        self.pid = self._process.pid

    def output(self) -> str:
        """Return what the child has said so far."""
        return self._log.read_text(errors='replace')

    def check(self) -> None:
        """Raise, with the end of its output, if the child has ended."""
        if self._process.poll() is not None:
            lines = self.output().splitlines()
            raise self.failure(
                f'{self._log.stem} ended with exit code {self._process.returncode}: '
                f'{" / ".join(lines[-2:]) or "without a word"}'
            )

    def interrupt(self) -> None:
        """Ask the child to end."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Wait for the child's end, and force it if need be."""
        try:
            self._process.wait(GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # A second Ctrl-C must not cut the clean-up.
        handlers = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
        try:
            for child in self._children:
                child.interrupt()
            for child in self._children:
                child.end()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
