# SPDX-License-Identifier: Apache-2.0
"""A live estimator in simulation time against a recording that is played in a loop."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip('rclpy', reason='no ROS 2 in this Python')

import bag_files as files

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[1]
DOMAIN = str(20 + os.getpid() % 60)


def start(*arguments):
    environment = {
        **os.environ, 'PYTHONPATH': os.pathsep.join([str(ROOT), *sys.path]),
        'ROS_DOMAIN_ID': DOMAIN, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }  # fmt: skip
    return subprocess.Popen(
        [sys.executable, '-m', 'fhaosmo_ros', *map(str, arguments)], env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


def test_estimator_restarts_where_the_loop_begins_again(tmp_path):
    stamps, y = files.signal(2000)
    bag = files.write(tmp_path / 'bag', files.floats(stamps, y))
    estimator = start(
        'estimator', '--ros-args', '-p', 'use_sim_time:=true', '-p', 'sampling:=clock'
    )
    lines, jumped = [], threading.Event()

    def read():
        for line in estimator.stdout:
            lines.append(line)
            if 'restarted from the new one' in line:
                jumped.set()

    reader = threading.Thread(target=read)
    reader.start()
    player = start('play', bag, '--loop', '--rate', '2', '--wait', '/y', '/clock')
    try:
        assert jumped.wait(60), ''.join(lines)
        assert player.poll() is None
    finally:
        for process in (player, estimator):
            process.send_signal(signal.SIGINT)
        out, _ = player.communicate(timeout=60)
        estimator.wait(timeout=60)
        reader.join(timeout=60)
    assert player.returncode == 0, out
    assert 'Traceback' not in out


def test_bag_takes_its_own_time_over_the_rate(tmp_path):
    stamps, y = files.signal(1500)
    bag = files.write(tmp_path / 'bag', files.floats(stamps, y))
    begin = time.monotonic()  # from before its start: a lower bound, however it is held up
    process = start('play', bag, '--rate', '0.5')
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert 'playing' in out
    assert time.monotonic() - begin >= 2.99  # 1.5 s at half the speed


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['/no/bag'], ['/no/bag', 'does not exist']),
        (['BAG', '--rate', '0'], ['--rate', '0.001 to 1000', '0']),
        (['BAG', '--topics', '/x'], ["'/x'", '/y']),
        (['BAG', '--exclude', '/y'], ['expected a message to play']),
    ],
)
def test_wrong_input_is_said_in_one_line(arguments, words, tmp_path):
    stamps, y = files.signal(20)
    bag = files.write(tmp_path / 'bag', files.floats(stamps, y))
    process = start('play', *[bag if a == 'BAG' else a for a in arguments])
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert len(out.strip().splitlines()) == 1
    assert all(word in out for word in words)
