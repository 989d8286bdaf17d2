# SPDX-License-Identifier: Apache-2.0
"""Recorded beside a live estimator: complete bags, the live estimates replayed, kills survived."""

import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='no ROS 2 in this Python')

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.nodes.spin import Spinner
from fhaosmo_ros.tools.bag_reader import BagReader
from fhaosmo_ros.tools.bags import series
import numpy as np
import rclpy
from rclpy.context import Context
from rosbags.highlevel import AnyReader
from std_msgs.msg import Float64
import yaml

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, '-m', 'fhaosmo_ros']
DOMAIN = str(101 + os.getpid() % 60)
APART = str(161 + os.getpid() % 60)
"""A domain without the plant that the other tests share."""
NODES = ['--ros-args', '--params-file', str(ROOT / 'config' / 'demo.yaml')]


def environment(domain=DOMAIN):
    return {
        **os.environ, 'PYTHONPATH': os.pathsep.join([str(ROOT), *sys.path]),
        'ROS_DOMAIN_ID': domain, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }  # fmt: skip


def start(*arguments, domain=DOMAIN):
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env=environment(domain), start_new_session=True,
    )  # fmt: skip


def run(*arguments):
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=120,
        env=environment(), check=False,
    )  # fmt: skip


def wait(condition, process, what, seconds=90):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f'waited {seconds} s for {what}'
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


def size(folder):
    """Bytes of the storage file, 0 while there is none."""
    found = [*folder.glob('*.mcap'), *folder.glob('*.db3')]
    return found[0].stat().st_size if found else 0


@pytest.fixture(scope='module')
def live():
    """A plant beside an estimator, as long as the tests of this file run."""
    # The estimator first: it then sees every sample that the plant publishes.
    nodes = [start('estimator', *NODES), start('plant', *NODES)]
    yield nodes
    for node in nodes:
        node.send_signal(signal.SIGINT)
    for node in nodes:
        node.communicate(timeout=20)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_bag_is_complete_after_ctrl_c(storage, live, tmp_path):
    bag = tmp_path / 'bag'
    process = start('record', '-o', bag, '--storage', storage)
    # Some ten seconds: the estimator may be discovered later than the plant.
    wait(lambda: size(bag) > 2_000_000, process, 'messages')
    process.send_signal(signal.SIGINT if storage == 'mcap' else signal.SIGTERM)
    out, error = process.communicate(timeout=30)
    assert process.returncode == 0, error
    information = yaml.safe_load((bag / 'metadata.yaml').read_text())
    information = information['rosbag2_bagfile_information']
    counts = {
        t['topic_metadata']['name']: t['message_count']
        for t in information['topics_with_message_count']
    }
    assert counts['/y'] > 1000
    assert counts['/estimator/stamp'] > 100
    assert counts['/plant/state'] > 1000
    assert information['message_count'] == sum(counts.values())
    assert str(information['message_count']) in out
    assert information['duration']['nanoseconds'] > 10**9
    for topic in information['topics_with_message_count']:
        metadata = topic['topic_metadata']
        assert metadata['type_description_hash'].startswith('RIHS01_')
        assert metadata['offered_qos_profiles'][0]['reliability'] == 'reliable'
    with AnyReader([bag]) as reader:
        read = {c.topic: 0 for c in reader.connections}
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            read[connection.topic] += 1
    assert read == counts


def test_replay_gives_the_live_estimates_sample_for_sample(tmp_path):
    """The bag keeps the stamps that dt came from; ~/stamp says which sample an estimate is of."""
    bag = tmp_path / 'bag'
    recorder = start('record', '-o', bag, domain=APART)
    estimator = start('estimator', *NODES, domain=APART)
    try:
        with Source(int(APART)) as source:
            # NaN starts no observer: it only shows that everybody listens, from either side.
            wait(lambda: source.send(float('nan')) and source.rejected, estimator, 'estimator')
            wait(lambda: source.send(float('nan')) and source.listeners >= 2, recorder, 'both')
            before = size(bag)
            wait(lambda: source.send(float('nan')) and size(bag) > before, recorder, 'recorder')
            for k in range(3000):
                source.send(0.2 + 0.1 * np.sin(2e-3 * k))
            wait(lambda: size(bag) > before + 3000 * 40, recorder, 'messages')
    finally:
        for process in (estimator, recorder):
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=30)
    out = tmp_path / 'out'
    arguments = ['--params-file', ROOT / 'config' / 'demo.yaml']
    result = run('replay', bag, '-o', out, *arguments)
    assert result.returncode == 0, result.stderr
    compare(out)


class Source:
    """Publishes y at about 1 kHz, and counts what the estimator reports as rejected."""

    def __init__(self, domain):
        self.rejected = 0
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node('source', context=self._context)
        self._publisher = self._node.create_publisher(Float64, '/y', 1000)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_report, 10)
        self._spinner = Spinner(self._node)

    def _on_report(self, message):
        for pair in message.status[0].values:
            if pair.key == 'rejected measurements':
                self.rejected = int(pair.value)

    @property
    def listeners(self):
        return self._publisher.get_subscription_count()

    def send(self, value):
        self._publisher.publish(Float64(data=float(value)))
        time.sleep(1e-3)
        return True

    def __enter__(self):
        self._spinner.__enter__()
        return self

    def __exit__(self, *_):
        self._spinner.__exit__()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)


def compare(out):
    live_stamps = series(out, '/estimator/stamp').values
    replayed_stamps = series(out, '/replay/estimator/stamp').values
    for topic in ('state', 'unknown_input', 'gamma', 'innovation'):
        live_ = series(out, f'/estimator/{topic}').values
        replayed = series(out, f'/replay/estimator/{topic}').values
        count = min(len(live_), len(live_stamps))
        assert count > 150
        row = np.searchsorted(replayed_stamps, live_stamps[:count])
        np.testing.assert_array_equal(replayed_stamps[row], live_stamps[:count])
        np.testing.assert_allclose(replayed[row], live_[:count], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_kill_loses_at_most_the_last_second(storage, live, tmp_path):
    bag = tmp_path / 'bag'
    process = start('record', '-o', bag, '--storage', storage, '--topics', '/y')
    wait(lambda: size(bag) > 150_000, process, 'messages')
    killed = time.time_ns()
    process.kill()
    process.communicate(timeout=10)
    assert not (bag / 'metadata.yaml').exists()
    result = run('record', '--repair', bag, '-o', tmp_path / 'saved')
    assert result.returncode == 0, result.stderr
    y = series(tmp_path / 'saved', '/y')
    assert str(len(y.values)) in result.stdout
    assert len(y.values) > 1000
    assert killed - y.stamps[-1] < 1_000_000_000
    with BagReader(tmp_path / 'saved') as reader:
        assert reader.count('/y') == len(y.values)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['bag', 'saved']
    shutil.rmtree(bag)


def test_all_topics(live, tmp_path):
    result = run('record', '-o', tmp_path / 'bag', '--all', '--duration', '10')
    assert result.returncode == 0, result.stderr
    with BagReader(tmp_path / 'bag') as reader:
        topics = {c.topic for c in reader.connections}
    assert {'/y', '/estimator/gamma', '/diagnostics', '/rosout'} <= topics


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--duration', '0'], ['--duration', '> 0', '0']),
        (['--topics', 'a b'], ['--topics', "'a b'"]),
        (['--topics', '/nobody', '--duration', '0.5'], ['nothing was published']),
        (['--repair', '/nowhere'], ['/nowhere', '.mcap']),
    ],
)
def test_wrong_arguments_are_said_in_one_line(arguments, words, tmp_path):
    result = run('record', '-o', tmp_path / 'bag', *arguments)
    assert result.returncode == 2
    lines = [line for line in result.stderr.splitlines() if 'error' in line]
    assert len(lines) == 1
    assert all(word in lines[0] for word in words)
    assert list(tmp_path.iterdir()) == []


def test_existing_output_is_refused(tmp_path):
    (tmp_path / 'precious').write_text('mine')
    result = run('record', '-o', tmp_path)
    assert result.returncode == 2
    assert '--force' in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ['precious']
