# SPDX-License-Identifier: Apache-2.0
"""Child processes that end with their block, whatever ends it."""

import os
from pathlib import Path
import signal
import subprocess
import sys
from tempfile import TemporaryDirectory
from time import monotonic, perf_counter, sleep
from types import TracebackType

from table import CannotMeasureError

ROOT = Path(__file__).parents[1]
POLL = 0.002
GRACE = 5.0
"""Seconds that a child has to end by itself."""
READY = 180.0
"""Seconds that a child has to say that it is ready; it may have to compile first."""


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

    """

    def __init__(
        self, log: Path, *arguments: str, environment: dict[str, str] | None = None
    ) -> None:
        self._log = log
        with log.open('wb') as output:
            self.started = perf_counter()
            # A session of its own: Ctrl-C reaches only us, and we end the children.
            self._process = subprocess.Popen(
                [sys.executable, *arguments], cwd=ROOT, start_new_session=True,
                env={**os.environ, 'PYTHONUNBUFFERED': '1', **(environment or {})},
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
            )  # fmt: skip
        self.pid = self._process.pid

    def wait_for(self, text: str) -> float:
        """Wait until `text` is in the output; return the seconds since the start."""
        deadline = monotonic() + READY
        while text not in self.output():
            self.check()
            if monotonic() > deadline:
                raise CannotMeasureError(
                    f"{self._log.stem} did not say '{text}' within {READY:g} s"
                )
            sleep(POLL)
        return perf_counter() - self.started

    def check(self) -> None:
        """Raise if the child has ended."""
        if self._process.poll() is not None:
            lines = self.output().splitlines()
            raise CannotMeasureError(
                f'{self._log.stem} ended with exit code {self._process.returncode}: '
                f'{" / ".join(lines[-2:]) or "without a word"}'
            )

    def output(self) -> str:
        """Return what the child has said so far."""
        return self._log.read_text(errors='replace')

    def cpu_seconds(self) -> float:
        """Return the CPU time used so far, in user and kernel mode, of all threads."""
        fields = Path(f'/proc/{self.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def resident_megabytes(self) -> float:
        """Return the memory that the child occupies now."""
        pages = int(Path(f'/proc/{self.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 1e6

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
    """Starts children; ends all of them at the end of its block."""

    def __init__(self) -> None:
        self._logs = TemporaryDirectory()
        self._children: list[Child] = []

    def start(
        self, name: str, *arguments: str, environment: dict[str, str] | None = None
    ) -> Child:
        """Start a child; see `Child`."""
        log = Path(self._logs.name) / f'{name}.log'
        child = Child(log, *arguments, environment=environment)
        self._children.append(child)
        return child

    def __enter__(self) -> 'Children':
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # A second Ctrl-C must not cut the clean-up.
        numbers = (signal.SIGINT, signal.SIGTERM)
        handlers = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
        try:
            for child in self._children:
                child.interrupt()
            for child in self._children:
                child.end()
            self._logs.cleanup()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
