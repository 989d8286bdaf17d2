# SPDX-License-Identifier: Apache-2.0
"""The package's nodes as child processes that never outlive their parent's block."""

from pathlib import Path
import signal
import subprocess
import sys
from types import TracebackType

from fhaosmo_ros.core.errors import ConfigurationError

GRACE = 5.0
"""Seconds that a node has to end by itself."""


class NodeProcesses:
    """
    Starts nodes with ``python -m fhaosmo_ros``, logs to files, stops all of them at the end.

    Parameters
    ----------
    log_folder : path
        Each node's output goes to ``<name>.log`` there.

    """

    def __init__(self, log_folder: Path) -> None:
        self._folder = log_folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *arguments: str) -> None:
        """Start a node in the background."""
        with (self._folder / f'{name}.log').open('wb') as log:
            self._running[name] = subprocess.Popen(
                [sys.executable, '-m', 'fhaosmo_ros', name, *arguments],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def check(self) -> None:
        """Raise ConfigurationError, with the end of its log, if a node has ended."""
        for name, process in self._running.items():
            if process.poll() is not None:
                lines = (self._folder / f'{name}.log').read_text(errors='replace').splitlines()
                raise ConfigurationError(
                    f'the {name} node ended with exit code {process.returncode}: '
                    f'{" / ".join(lines[-2:]) or "without a word"}'
                )

    def __enter__(self) -> 'NodeProcesses':
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for process in self._running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in self._running.values():
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
