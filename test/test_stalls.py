# SPDX-License-Identifier: Apache-2.0
"""A test is run again if the machine stalled, and only then."""

import os
from pathlib import Path
import re
import subprocess
import sys
import time

from heartbeat import Heartbeat
import pytest
from waiting import wait_until

TEST = Path(__file__).parent
ENVIRONMENT = os.environ | {
    'PYTHONPATH': os.pathsep.join(map(str, (TEST, TEST.parent / 'benchmark'))),
    'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1',
}
PLUGINS = ['-p', 'no:cacheprovider', '-p', 'stalls', '-p', 'rerunfailures']
HEADER = """
import subprocess, sys, time
import pytest
import stalls
from waiting import wait_until

stalls.STALL = stalls.LOSS = 0.3
runs = []

def stall(heartbeat, seconds):
    wait_until(heartbeat.beating, 'heartbeat')
    heartbeat.pause()
    time.sleep(seconds)
    heartbeat.resume()

def wait_in_vain():
    wait_until(lambda: False, 'message', 0.05)
"""


def session(folder, text, *options):
    """Run a session of tests; return its exit code, its counts by outcome, and its output."""
    (folder / 'test_some.py').write_text(HEADER + text)
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', *PLUGINS, *options, folder],
        capture_output=True, text=True, timeout=60, check=False, env=ENVIRONMENT, cwd=folder,
    )  # fmt: skip
    last = done.stdout.splitlines()[-1]
    counts = {kind: int(n) for n, kind in re.findall(r'(\d+) (passed|failed|error|rerun)', last)}
    return done.returncode, counts, done.stdout


def test_heartbeat_measures_a_stall():
    with Heartbeat() as heartbeat:
        wait_until(heartbeat.beating, 'heartbeat')
        begin = time.monotonic()
        heartbeat.pause()
        time.sleep(0.3)
        heartbeat.resume()
        wait_until(lambda: heartbeat.late(begin) > 0.25, 'late beat')
        end = time.monotonic()
        assert heartbeat.late(begin, end, least=0.2) < end - begin
        assert heartbeat.late(begin - 60.0, begin, least=0.2) < 0.2
    assert not heartbeat.beating()


def test_only_a_stall_is_run_again(tmp_path):
    code, counts, said = session(
        tmp_path,
        """
def test_deadline(heartbeat):
    runs.append('deadline')
    if runs.count('deadline') == 1:
        stall(heartbeat, 0.4)
        wait_in_vain()

def test_process(heartbeat):
    runs.append('process')
    if runs.count('process') == 1:
        stall(heartbeat, 0.4)
        subprocess.run([sys.executable, '-c', 'import time; time.sleep(60)'], timeout=0.01)

def test_loss(heartbeat):
    runs.append('loss')
    if runs.count('loss') == 1:
        stall(heartbeat, 0.4)
        raise stalls.LostError('sample 7')

def test_assertion(heartbeat):
    runs.append('assertion')
    stall(heartbeat, 0.4)
    assert 1 == 2

def test_deadline_without_a_stall():
    runs.append('no stall')
    wait_in_vain()

def test_loss_without_a_stall():
    runs.append('no stall')
    raise stalls.LostError('sample 8')

def test_runs():
    twice = ['deadline'] * 2 + ['process'] * 2 + ['loss'] * 2
    assert runs == twice + ['assertion'] + ['no stall'] * 2
""",
    )
    assert code == 1
    assert counts == {'rerun': 3, 'passed': 4, 'failed': 3}, said
    assert re.search(r'test_deadline: .*stalled for 0\.\d+ s: no message within 0\.05 s', said)
    assert re.search(r'test_loss: .*stalled for 0\.\d+ s: sample 7', said)
    assert '3 reruns of 7 tests' in said


def test_a_machine_that_goes_on_stalling_fails_the_test(tmp_path):
    code, counts, _ = session(
        tmp_path,
        """
def test_deadline(heartbeat):
    stall(heartbeat, 0.4)
    wait_in_vain()
""",
    )
    assert (code, counts) == (1, {'rerun': 2, 'failed': 1})


STALLED_FIXTURE = """
@pytest.fixture(scope='module')
def node(heartbeat):
    runs.append(1)
    if len(runs) <= {stalls}:
        stall(heartbeat, 0.4)
        wait_in_vain()

@pytest.mark.parametrize('k', range({tests}))
def test_node(node, k):
    pass
"""


@pytest.mark.parametrize(('stalls', 'tests', 'code'), [(1, 3, 0), (2, 199, 1), (2, 200, 0)])
def test_more_reruns_than_a_hundredth_fail_the_session(tmp_path, stalls, tests, code):
    done, counts, said = session(tmp_path, STALLED_FIXTURE.format(stalls=stalls, tests=tests))
    assert (done, counts) == (code, {'rerun': stalls, 'passed': tests})
    assert f'{stalls} reruns of {tests} tests: {"FAILED" if code else "allowed"}' in said


def test_reruns_of_all_workers_count(tmp_path):
    pytest.importorskip('xdist')
    code, counts, said = session(
        tmp_path, STALLED_FIXTURE.format(stalls=1, tests=20), '-pxdist', '-n2'
    )
    assert (code, counts) == (1, {'rerun': 2, 'passed': 20}), said
