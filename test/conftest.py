# SPDX-License-Identifier: Apache-2.0
"""Settings shared by all tests."""

import fcntl
import os
from pathlib import Path
import signal
import tempfile

from domains import take_domain
from hypothesis import settings
import pytest

# Before numpy is imported: on small matrices, the threads of OpenBLAS only wait for each other.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

os.environ['ROS_DOMAIN_ID'] = str(take_domain())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'

# Same examples in every run; no deadline, because the first call of a kernel may compile it.
settings.register_profile('fixed', derandomize=True, deadline=None, database=None)
settings.load_profile('fixed')


pytest_plugins = ['stalls']


@pytest.fixture(scope='session', autouse=True)
def _compiled():
    """Fill the compile cache once, not in each node's process and against a test's deadline."""
    with (Path(tempfile.gettempdir()) / 'fhaosmo_ros_test_compile.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # of the other test processes
        from fhaosmo_ros.core.online.batch import EstimatorBatch
        from fhaosmo_ros.core.online.estimator import OnlineEstimator
        from fhaosmo_ros.core.simulation.plant import Plant

        OnlineEstimator().advance(1, 0.0)
        EstimatorBatch([OnlineEstimator()]).advance([0], [1], [0.0], [0.0])
        Plant().sample(0.0)


@pytest.fixture(autouse=True)
def _signals():
    """The commands set handlers for the process that they take for their own."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
