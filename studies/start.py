# SPDX-License-Identifier: Apache-2.0
"""The start of `python -m studies.NAME`, until `run_command` handles signals."""

import importlib
import os
import signal

from fhaosmo_ros.stop_signals import SIGNALS

INTERRUPTED = 130


def start(command: str) -> int:
    """
    Import a command's module, run it and return its exit code.

    The imports take seconds. A signal ends the process there, too, also where it was started with
    SIGINT ignored, as a shell without job control starts its background jobs.
    """
    for number in SIGNALS:
        signal.signal(number, lambda *_: os._exit(INTERRUPTED))
    return int(importlib.import_module(command).main())
