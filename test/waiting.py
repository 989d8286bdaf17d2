# SPDX-License-Identifier: Apache-2.0
"""Waiting for a condition, with a deadline."""

import time


def wait_until(condition, what, seconds=60.0, process=None):
    """Wait until `condition` holds, at most so many seconds and while the `process` runs."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f'no {what} within {seconds:g} s')
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.01)
