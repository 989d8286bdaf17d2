# SPDX-License-Identifier: Apache-2.0
"""A ROS domain for each test process, so that no two of them, nor a robot, hear each other."""

import contextlib
import fcntl
import os
from pathlib import Path
import tempfile

import pytest

pytest.register_assert_rewrite('rig')

# Domain ids up to 101 keep clear of Linux' ephemeral ports.
DOMAINS = range(20, 102)
_locks = []


def _take_domain() -> int:
    """Return a domain that no other test process of this machine has; held until the end."""
    for number in DOMAINS:
        path = Path(tempfile.gettempdir()) / f'fhaosmo_ros_test_domain_{number}.lock'
        lock = path.open('w')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        _locks.append(lock)
        return number
    raise RuntimeError(f'all ROS domains {DOMAINS} are taken by test processes')


os.environ['ROS_DOMAIN_ID'] = str(_take_domain())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a function that makes a fresh folder."""
    return lambda: tmp_path_factory.mktemp('node')


@pytest.fixture(scope='module')
def stack():
    """Return an exit stack that lives as long as the module's tests."""
    with contextlib.ExitStack() as exit_stack:
        yield exit_stack


@pytest.fixture(scope='module')
def client(stack):
    from rig import Client

    return stack.enter_context(Client())


@pytest.fixture(scope='module')
def start(stack, folder):
    """Return a function that starts a node's process."""
    from rig import node_process

    return lambda *arguments: stack.enter_context(node_process(folder(), *arguments))
