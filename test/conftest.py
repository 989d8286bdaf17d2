# SPDX-License-Identifier: Apache-2.0
"""Settings shared by all tests."""

import contextlib
from importlib.metadata import PackageNotFoundError, version
import os
from pathlib import Path
import signal

from commands import take_domain
from hypothesis import settings
import pytest

pytest.register_assert_rewrite('running')

# Before numpy is imported: on small matrices, the threads of OpenBLAS only wait for each other.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

os.environ['ROS_DOMAIN_ID'] = str(take_domain())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
with contextlib.suppress(PackageNotFoundError):  # no ROS 2 in this Python
    middleware = 'FASTRTPS' if version('rclpy').startswith('7.') else 'FASTDDS'  # Jazzy, or later
    profiles = Path(__file__).with_name('quick_discovery.xml')
    os.environ[f'{middleware}_DEFAULT_PROFILES_FILE'] = str(profiles)

# Same examples in every run; no deadline, because other processes may take the machine.
settings.register_profile('fixed', derandomize=True, deadline=None, database=None)
settings.load_profile('fixed')


@pytest.fixture(autouse=True)
def _signals():
    """The commands set handlers for the process that they take for their own."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
