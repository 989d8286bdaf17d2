# SPDX-License-Identifier: Apache-2.0
"""Settings shared by all tests."""

import fcntl
from pathlib import Path
import signal
import tempfile

from hypothesis import settings
import pytest

# Same examples in every run; no deadline, because the first call of a kernel may compile it.
settings.register_profile('fixed', derandomize=True, deadline=None, database=None)
settings.load_profile('fixed')


def pytest_collection_modifyitems(config, items):
    """
    Give what waits for other processes another try, as `colcon test --retest-until-pass` does.

    A shared machine may stall a process for seconds, which is not what these tests look for. The
    summary counts such tries as `rerun` and names them.
    """
    if config.pluginmanager.hasplugin('rerunfailures'):
        for item in items:
            if item.get_closest_marker('ros') or item.get_closest_marker('signals'):
                item.add_marker(pytest.mark.flaky(reruns=2))


@pytest.fixture(scope='session', autouse=True)
def _compiled():
    """Fill the compile cache once, not in each node's process and against a test's deadline."""
    with (Path(tempfile.gettempdir()) / 'fhaosmo_ros_test_compile.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # of the other test processes
        from fhaosmo_ros.core.channels import Channels
        from fhaosmo_ros.core.online import OnlineEstimator
        from fhaosmo_ros.core.plant import Plant

        OnlineEstimator().advance(1, 0.0)
        Channels([OnlineEstimator()]).advance([0], [1], [0.0], [0.0])
        Plant().sample(0.0)


@pytest.fixture(autouse=True)
def _signals():
    """The commands set handlers for the process that they take for their own."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
