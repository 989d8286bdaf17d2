# SPDX-License-Identifier: Apache-2.0
"""Ending by Ctrl-C or SIGTERM without losing the clean-up."""

import signal
import threading


def stop_on_signals() -> threading.Event:
    """
    Make SIGINT and SIGTERM set the returned event, from now to the process's end.

    They raise nothing, so a second Ctrl-C can't cut the clean-up that the first one began.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
