# SPDX-License-Identifier: Apache-2.0
"""A ROS domain for each test process, so that no two of them, nor a robot, hear each other."""

import contextlib
import fcntl
from pathlib import Path
import tempfile

# Ids up to 101 keep clear of Linux' ephemeral ports; those below 20 are the benchmarks'.
DOMAINS = range(20, 102)
_locks = []


def take_domain() -> int:
    """Return a domain that no other test process of this machine has; held until the end."""
    for number in DOMAINS:
        path = Path(tempfile.gettempdir()) / f'fhaosmo_ros_test_domain_{number}.lock'
        _locks.append(path.open('w'))
        with contextlib.suppress(OSError):  # taken
            fcntl.flock(_locks[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
            return number
    raise RuntimeError(f'all ROS domains {DOMAINS} are taken by test processes')
