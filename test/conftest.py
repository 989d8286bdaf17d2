# SPDX-License-Identifier: Apache-2.0
"""Settings shared by all tests."""

import os
from pathlib import Path
import signal

from domains import take_domain
from hypothesis import settings
import pytest

# Before numpy is imported: on small matrices, the threads of OpenBLAS only wait for each other.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

os.environ['ROS_DOMAIN_ID'] = str(take_domain())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(Path(__file__).with_name('quick_discovery.xml'))

# Same examples in every run; no deadline, because other processes may take the machine.
settings.register_profile('fixed', derandomize=True, deadline=None, database=None)
settings.load_profile('fixed')


@pytest.fixture(autouse=True)
def _signals():
    """The commands set handlers for the process that they take for their own."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
