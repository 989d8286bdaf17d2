# SPDX-License-Identifier: Apache-2.0
"""The demonstration as a newcomer meets it, in short."""

import contextlib
import os
import signal
import subprocess

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='no ROS 2 in this Python')

from bag_files import stamps_in
from commands import run, start
from fhaosmo_ros.tools.bags.topics import series
from fhaosmo_ros.tools.demo import OTHERS, read_run
from fhaosmo_ros.topics import ESTIMATES, PARAMETERS, SNAPSHOT
from rosbags.highlevel import AnyReader
from waiting import wait_until

pytestmark = pytest.mark.ros


def leaves_no_process(demo):
    """Return whether all processes of its session have ended."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(demo.pid, 0)
        return False
    return True


def test_run_leaves_a_report_a_figure_and_a_bag_but_no_process(tmp_path):
    """With the second engine: what it has found is in the bag, and there is no power."""
    folder = tmp_path / 'out'
    demo = start('demo', '--duration', 9, '--output', folder, '--self-tuning')
    out, err = demo.communicate(timeout=400)
    assert demo.returncode == 0, err
    assert leaves_no_process(demo)
    for word in ('RMS error', 'z1', 'z2', 'z3', 'samples', 'now with noise of 1e-4 on y'):
        assert word in out
    assert (folder / 'report.txt').read_text().strip() in out
    with AnyReader([folder / 'bag']) as reader:
        topics = {c.topic for c in reader.connections}
    found = [f'/estimator/{part}' for part in (*ESTIMATES, SNAPSHOT, PARAMETERS)]
    assert {'/y', '/plant/state', '/plant/unknown_input', *found} <= topics
    run_ = read_run(folder / 'bag')
    assert len(run_.y.stamps) > 1000
    assert run_.curves.gamma is None
    late, end = run_.t > 3.0, run_.t > run_.t[-1] - 0.5
    # Not d: other tests load the machine meanwhile, and its stamps jitter in bursts then.
    error = np.median(np.abs(run_.errors[late, :2]), axis=0)
    assert (error < 0.05 * np.abs(run_.curves.truth[late, :2]).max(axis=0)).all()
    true = np.std((run_.y.values.ravel()[run_.rows] - run_.curves.truth[:, 0])[end])
    assert true > 0.5e-4  # of some 50 samples
    noise = np.median(series(folder / 'bag', '/estimator/tuning').values[-500:, 0])
    assert noise > 0.5 * true  # jitter of a busy machine adds to it


def test_ctrl_c_ends_early_with_a_report_and_without_a_trace(tmp_path):
    folder = tmp_path / 'out'
    process = start('demo', '--duration', 600, '--output', folder)
    part = tmp_path / '.out.part' / 'out' / 'bag' / 'bag_0.mcap'
    wait_until(lambda: len(stamps_in(part, '/estimator/state')) > 100, 'estimates', 120.0, process)
    # As a terminal does: to the whole group; and twice, as an impatient user does.
    os.killpg(process.pid, signal.SIGINT)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert 'Traceback' not in err
    assert 'stopped early' in out
    assert all(name in out for name in OTHERS)
    assert (folder / 'demo.png').read_bytes()[:8] == b'\x89PNG\r\n\x1a\n'
    assert leaves_no_process(process)


def test_another_plant_in_the_same_domain_is_refused(tmp_path):
    """The bag would hold the samples and estimates of both."""
    with start('plant', stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as plant:
        try:
            result = run('demo', '--duration', 600, '--output', tmp_path / 'out')
        finally:
            plant.send_signal(signal.SIGINT)
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}' in result.stderr
    assert list(tmp_path.iterdir()) == []
