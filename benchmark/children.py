# SPDX-License-Identifier: Apache-2.0
"""Children whose start, CPU time and memory can be measured."""

from collections.abc import Callable
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, perf_counter, sleep
from typing import Any

from fhaosmo_ros.tools.cli import processes
from results import CannotMeasureError

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0
"""Seconds that anything may take that is waited for."""

# What is started here is kept away from other ROS systems; the tests use the domains from 20 on.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 19)


def wait_until(condition: Callable[[], Any], complaint: str, poll: float = 0.02) -> None:
    """Wait for a condition; raise with a complaint if it does not come."""
    deadline = monotonic() + PATIENCE
    while not condition():
        if monotonic() > deadline:
            raise CannotMeasureError(f'{complaint} within {PATIENCE:g} s')
        sleep(poll)


class Child(processes.Child):
    """A child in a session of its own: Ctrl-C reaches only us, and we end the children."""

    failure = CannotMeasureError

    def __init__(self, log: Path, *arguments: str) -> None:
        self.started = perf_counter()
        environment = {**os.environ, 'PYTHONUNBUFFERED': '1'}
        super().__init__(log, *arguments, env=environment, start_new_session=True, cwd=ROOT)

    def wait_for(self, text: str) -> float:
        """Wait until `text` is in the output; return the seconds since the start."""

        def said() -> bool:
            self.check()
            return text in self.output()

        wait_until(said, f"{self._log.stem} did not say '{text}'", 0.002)
        return perf_counter() - self.started

    def cpu_seconds(self) -> float:
        """Return the CPU time used so far, in user and kernel mode, of all threads."""
        fields = Path(f'/proc/{self.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def resident_megabytes(self) -> float:
        """Return the memory that the child occupies now."""
        pages = int(Path(f'/proc/{self.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


class Children(processes.Children):
    """Such children; what they say goes to a folder that goes with them."""

    kind = Child

    def __init__(self) -> None:
        self._logs = TemporaryDirectory()
        super().__init__(Path(self._logs.name))

    def __exit__(self, *reason: Any) -> None:
        super().__exit__(*reason)
        self._logs.cleanup()
