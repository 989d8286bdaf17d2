# SPDX-License-Identifier: Apache-2.0
"""
A pytest plugin: a test that the machine stalled is run again, no other is.

A test that waits for another process raises `TimeoutError` (`waiting`, `rig`) or
`subprocess.TimeoutExpired` when its deadline passes, and `LostError` when a message got lost in
transport. If meanwhile the machine stalled, by the heartbeat, then this becomes a `StalledError`,
for which pytest-rerunfailures runs the test again, twice at most. Without a stall it is a failure,
and so is a failed assertion in any case. The summary names every rerun; too many fail the session.
"""

import subprocess
import time

from heartbeat import Heartbeat
import pytest

STALL = 1.0
"""Seconds of stalls, of at least `SHORTEST` each, that explain a deadline missed by a test."""
SHORTEST = 0.05
LOSS = 0.05
"""Seconds of stalls that explain a lost message: 1 kHz fills a queue of 10 in 0.01 s."""
RERUNS = 2
SHARE = 0.01
"""Of the tests that were run: more reruns than that, and more than one, fail the session."""

_heartbeat = pytest.StashKey[Heartbeat]()
_start = pytest.StashKey[float]()


class StalledError(Exception):
    """The machine stalled, so that a test cannot tell."""


class LostError(Exception):
    """A message got lost in transport."""


@pytest.fixture(scope='session', autouse=True)
def heartbeat(pytestconfig):
    with Heartbeat() as beat:
        pytestconfig.stash[_heartbeat] = beat
        yield beat


def pytest_collection_modifyitems(config, items):
    if config.pluginmanager.hasplugin('rerunfailures'):
        for item in items:
            item.add_marker(pytest.mark.flaky(reruns=RERUNS, only_rerun=['^StalledError: ']))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    item.stash[_start] = time.monotonic()
    return (yield from _explained(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    return (yield from _explained(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item):
    return (yield from _explained(item))


def _explained(item):
    """Raise `StalledError` where the machine stalled since the test's setup."""
    try:
        return (yield)
    except (TimeoutError, subprocess.TimeoutExpired) as error:
        _blame_the_machine(item, error, STALL, SHORTEST)
        raise
    except LostError as error:
        _blame_the_machine(item, error, LOSS, least=0.0)
        raise


def _blame_the_machine(item, error, enough, least):
    time.sleep(0.1)  # so that the heartbeat, which was stalled too, can say so
    late = item.config.stash[_heartbeat].late(item.stash[_start], least=least)
    if late >= enough:
        raise StalledError(f'the machine stalled for {late:.2f} s: {error}') from error


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session, exitstatus):
    reporter = session.config.pluginmanager.get_plugin('terminalreporter')  # not in a worker
    if exitstatus == pytest.ExitCode.OK and reporter and _too_many(reporter):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter):
    reruns = terminalreporter.stats.get('rerun', [])
    if reruns:
        terminalreporter.section('the machine stalled')
        for report in reruns:
            terminalreporter.line(f'{report.nodeid}: {report.longrepr.reprcrash.message}')
        verdict = 'FAILED, too many' if _too_many(terminalreporter) else 'allowed'
        terminalreporter.line(f'{len(reruns)} reruns of {_run(terminalreporter)} tests: {verdict}')


def _run(reporter):
    """Return how many tests were run."""
    return sum(len(reporter.stats.get(kind, [])) for kind in ('passed', 'failed', 'error'))


def _too_many(reporter):
    return len(reporter.stats.get('rerun', [])) > max(1, SHARE * _run(reporter))
