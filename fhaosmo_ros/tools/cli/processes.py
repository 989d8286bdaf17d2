# SPDX-License-Identifier: Apache-2.0
"""Child processes that do not outlive the block which they are started for."""

from pathlib import Path
import signal
import subprocess
import sys
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError

GRACE = 5.0
"""Seconds that a child has to end by itself."""


class Child(subprocess.Popen[bytes]):
    """
    A Python process whose output goes to the file `log`; it ends with its `with` block.

    `arguments` are what follows ``python``. The option ``start_new_session=True`` lets Ctrl-C in
    a terminal reach only the parent.
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

    def __exit__(self, *_: object) -> None:
        # A second Ctrl-C does not cut this short: a command's handlers of signals raise nothing.
        self.interrupt()
        try:
            self.wait(GRACE)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()


def start_node(folder: Path, name: str, *arguments: str) -> Child:
    """Start one of this package's nodes; its output goes to ``<name>.log`` in a folder."""
    return Child(folder / f'{name}.log', '-m', 'fhaosmo_ros', name, *arguments)
