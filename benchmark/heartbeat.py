# SPDX-License-Identifier: Apache-2.0
"""
A heartbeat that tells whether the machine stalled.

A process that only sleeps, a few milliseconds at a time, wakes late if the machine stands still or
has no processor left for it. It is a process and not a thread, because a thread also wakes late
when the code under test holds the interpreter's lock.
"""

from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any

BEAT, NOTED = 0.005, 0.0002
"""Seconds between two beats, and from which on a late one is written down."""
CODE = f"""
import os, sys, time
parent, last = os.getppid(), time.monotonic()
while os.getppid() == parent:
    time.sleep({BEAT})
    now = time.monotonic()
    late = now - last - {BEAT}
    if late > {NOTED}:
        print(now, late, flush=True)
    last = now
"""


class Heartbeat:
    """Such a process, as long as the block lasts; it takes 1.2 % of a core."""

    def __enter__(self) -> 'Heartbeat':
        self._folder = TemporaryDirectory(prefix='fhaosmo_ros_heartbeat_')
        self._log = Path(self._folder.name) / 'late'
        with self._log.open('wb') as log:
            # Not the variables and modules of the environment: it starts in 20 ms.
            self._process = subprocess.Popen(
                [sys.executable, '-I', '-S', '-c', CODE], stdin=subprocess.DEVNULL, stdout=log
            )
        return self

    def __exit__(self, *_: Any) -> None:
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()

    def beats(self) -> list[tuple[float, float]]:
        """Return when beats were late (`time.monotonic`), and by how much (s)."""
        lines = self._log.read_text().rpartition('\n')[0].splitlines()
        return [(float(now), float(late)) for now, late in map(str.split, lines)]
