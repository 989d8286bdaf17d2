# SPDX-License-Identifier: Apache-2.0
"""Ending by Ctrl-C, SIGTERM or SIGHUP, with the clean-up done."""

import atexit
from collections.abc import Iterator
import contextlib
import select
import signal
import socket
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What ends a node or a command."""


def ending_signals() -> list[signal.Signals]:
    """
    Return the signals that are to end this process.

    SIGHUP comes when a terminal or an SSH connection closes; nohup(1) lets a process ignore it. An
    ignored SIGINT ends one all the same: a shell without job control starts background jobs so.
    """
    return [s for s in SIGNALS if s != signal.SIGHUP or signal.getsignal(s) != signal.SIG_IGN]


class Stopped(BaseException):
    """Raised by a signal within `Stop.raising`."""


class Stop:
    """
    An event that a signal, or any thread, may set.

    A threading.Event does not serve: its lock is not reentrant, so a handler that interrupts a
    wait can deadlock. No lock serves, because the system may deliver a signal to one of the
    middleware's threads, and then nothing interrupts the wait of the main thread. So the main
    thread waits for a socket: Python writes each signal into it, whichever thread it comes in.
    """

    def __init__(self) -> None:
        self._reader, self.writer = socket.socketpair()
        self.writer.setblocking(False)
        self._set = self._raises = False

    def __del__(self) -> None:
        self._reader.close()
        self.writer.close()

    def set(self) -> None:
        """End all waiting, from any thread or signal handler."""
        self._set = True
        with contextlib.suppress(BlockingIOError):  # full: the wait ends anyway
            self.writer.send(b'\0')

    def signal(self, number: int = signal.SIGINT, frame: FrameType | None = None) -> None:
        """Handle a signal: `set`, and raise `Stopped` if within `raising`, but only once."""
        raises = self._raises and not self._set
        self.set()
        if raises:
            raise Stopped

    @contextlib.contextmanager
    def raising(self) -> Iterator[None]:
        """Let the first signal interrupt the block; for long work that leaves nothing behind."""
        self._raises = True
        try:
            if self._set:
                raise Stopped
            yield
            if self._set:  # Python drops what a signal raises in a destructor or weakref callback
                raise Stopped
        finally:
            self._raises = False

    def is_set(self) -> bool:
        """Return True once `set` has been called."""
        return self._set

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for `set`, at most `timeout` seconds; return `is_set`. For one thread only."""
        while not self._set:
            ready, _, _ = select.select([self._reader], [], [], timeout)
            if not ready:
                break
            self._reader.recv(1)  # a signal's byte; its handler runs before the next look
        return self._set


def stop_on_signals() -> Stop:
    """
    Make the signals that end a process set the returned event, from now to the process's end.

    They raise nothing outside of `Stop.raising`: a second Ctrl-C can't interrupt the clean-up.
    """
    stop = Stop()
    for number in ending_signals():
        signal.signal(number, stop.signal)
    signal.set_wakeup_fd(stop.writer.fileno(), warn_on_full_buffer=False)
    for number in SIGNALS:  # else a late one kills the process, as Python removes its handlers
        atexit.register(signal.signal, number, signal.SIG_IGN)
    return stop
