# SPDX-License-Identifier: Apache-2.0
"""Ending by Ctrl-C or SIGTERM without losing the clean-up."""

import contextlib
import queue
import signal


class Stop:
    """
    An event that a signal handler may set.

    The lock of threading.Event is not reentrant: a handler that interrupts a `wait` or another
    handler's `set` at the wrong moment waits for itself. SimpleQueue.put is reentrant.
    """

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._set = False

    def set(self) -> None:
        """End all waiting, from any thread or signal handler."""
        self._set = True
        self._queue.put(None)

    def is_set(self) -> bool:
        """Return True once `set` has been called."""
        return self._set

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for `set`, at most `timeout` seconds; return `is_set`. For one thread only."""
        if not self._set:
            with contextlib.suppress(queue.Empty):
                self._queue.get(timeout=timeout)
        return self._set


def stop_on_signals() -> Stop:
    """
    Make SIGINT and SIGTERM set the returned event, from now to the process's end.

    They raise nothing, so a second Ctrl-C can't cut the clean-up that the first one began.
    """
    stop = Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
