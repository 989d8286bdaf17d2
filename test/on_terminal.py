# SPDX-License-Identifier: Apache-2.0
"""A command whose stderr is a terminal, where its progress bar begins at once."""

import contextlib
import fcntl
import os
from pathlib import Path
import struct
import subprocess
import sys
import termios

ROOT = Path(__file__).resolve().parents[1]


class OnTerminal(subprocess.Popen):
    """`python -m MODULE ...`; `said` is what it has written so far."""

    def __init__(self, *arguments):
        self._terminal, its_end = os.openpty()
        fcntl.ioctl(self._terminal, termios.TIOCSWINSZ, struct.pack('4H', 24, 80, 0, 0))
        self.said = ''
        words = [sys.executable, '-m', *map(str, arguments)]
        super().__init__(words, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=its_end, stderr=its_end)
        os.close(its_end)

    def __exit__(self, *_):
        self.kill()
        self.wait()
        os.close(self._terminal)

    def wait_for(self, text):
        """Wait until the command has written `text`."""
        while text not in self.said:
            self._read()

    def end(self, number, timeout=60.0):
        """Send it this signal and return its exit code."""
        self.send_signal(number)
        with contextlib.suppress(OSError):  # EIO: it has ended
            while True:
                self._read()
        return self.wait(timeout)

    def _read(self):
        self.said += os.read(self._terminal, 4096).decode(errors='replace')
