# SPDX-License-Identifier: Apache-2.0
"""Nodes for the tests: some live for one module, some for the whole session."""

import contextlib
from pathlib import Path

from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import pytest

try:
    from running import arguments, Estimator, FED, Parameters, Process, User
except ModuleNotFoundError:  # no ROS 2 in this Python
    collect_ignore_glob = ['test_*.py']


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the tests of this folder."""
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.ros)


@contextlib.contextmanager
def _launcher(folders):
    processes = []

    def launch(name, *words, **values):
        """Start an estimator or a plant, which code may do, with parameters and other words."""
        path = folders.mktemp('node') / 'output'
        program = ['-c', name, 'estimator'] if '\n' in name else ['-m', 'fhaosmo_ros', name]
        processes.append(Process(path, *program, *arguments(*words, **values)))
        return processes[-1]

    try:
        yield launch
        for process in processes:
            process.interrupt()
        for process in processes:
            process.check_end()
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.fixture(scope='session')
def user():
    """Return a node that hears, publishes and asks."""
    with User() as user:
        yield user


@pytest.fixture(scope='module')
def launch(tmp_path_factory):
    """Return a function that starts a node, which lives until the end of the module."""
    with _launcher(tmp_path_factory) as launch:
        yield launch


@pytest.fixture(scope='module')
def estimator(launch, user):
    """Return a function that starts an estimator and knows its topics."""

    def start(namespace, *words, reliable=('y',), **values):
        process = launch('estimator', *words, namespace=namespace, reliable=reliable, **values)
        return Estimator(user, process, namespace, gamma=values.get('gains') != 'self_tuning')

    return start


@pytest.fixture(scope='session')
def pair(tmp_path_factory, user):
    """Return an estimator that hears a plant; the plant and its parameters are its attributes."""
    with _launcher(tmp_path_factory) as launch:
        estimator = Estimator(user, launch('estimator', namespace='/pair'), '/pair')
        estimator.source = launch('plant', namespace='/pair', sample_rate=200.0)
        estimator.plant = Parameters(user, '/pair/plant')
        yield estimator


@pytest.fixture(scope='session')
def _fed(tmp_path_factory, user):
    with _launcher(tmp_path_factory) as launch:
        process = launch('estimator', namespace='/fed', reliable=['y'], **FED)
        yield Estimator(user, process, '/fed').listen()


@pytest.fixture
def fed(_fed):
    """Return an estimator that a test feeds, as it was at its start."""
    live = [name for name, parameter in ESTIMATOR_PARAMETERS.items() if parameter.live]
    start = {name: ESTIMATOR_PARAMETERS[name].default for name in live} | FED
    _fed.parameters.set(**{name: start[name] for name in live})
    _fed.reset()
    return _fed
