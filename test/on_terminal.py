# SPDX-License-Identifier: Apache-2.0
"""A command whose stderr is a terminal, where its progress bar begins at once."""

import contextlib
import fcntl
import os
from pathlib import Path
import signal
import struct
import subprocess
import sys
import termios

ROOT = Path(__file__).resolve().parents[1]


class OnTerminal:
    """`python -m MODULE ...`, started with SIGINT ignored if that is asked for."""

    def __init__(self, *arguments, ignored=False):
        self._terminal, its_end = os.openpty()
        fcntl.ioctl(self._terminal, termios.TIOCSWINSZ, struct.pack('4H', 24, 80, 0, 0))
        self.said = ''
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if ignored else None
        try:
            self._process = subprocess.Popen(
                [sys.executable, '-m', *map(str, arguments)],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=its_end,
                stderr=its_end,
            )
        finally:
            os.close(its_end)
            if ignored:
                signal.signal(signal.SIGINT, before)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()
        os.close(self._terminal)

    def _read(self):
        self.said += os.read(self._terminal, 4096).decode(errors='replace')

    def wait_for(self, text):
        """Wait until the command has written `text`."""
        try:
            while text not in self.said:
                self._read()
        except OSError as error:  # EIO: it has ended
            raise AssertionError(self.said) from error

    def end(self, number, timeout=60.0):
        """Send it this signal and return its exit code."""
        self._process.send_signal(number)
        with contextlib.suppress(OSError):
            while True:
                self._read()
        return self._process.wait(timeout)
