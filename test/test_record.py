# SPDX-License-Identifier: Apache-2.0
"""Recorded beside a live estimator: complete bags, the live estimates replayed, kills survived."""

import re
import shlex
import subprocess
import time

import pytest

pytest.importorskip('rclpy', reason='no ROS 2 in this Python')

from bag_files import stamps_in
from commands import COMMAND, environment, interrupted, ROOT, run, start
from domains import take_domain
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import read_ticks
from fhaosmo_ros.topics import ESTIMATES, EVENT, PARAMETERS, SNAPSHOT
import numpy as np
from rosbags.highlevel import AnyReader
from running import Parameters, User
from std_srvs.srv import Trigger
from waiting import wait_until
import yaml

pytestmark = pytest.mark.ros
APART = str(take_domain())
"""A domain without the plant that the other tests share."""
NODES = ['--ros-args', '--params-file', str(ROOT / 'config' / 'demo.yaml')]


def size(folder):
    """Bytes of the storage file, 0 while there is none."""
    file = folder / f'{folder.name}_0.mcap'
    return file.stat().st_size if file.exists() else 0


def stamps(folder, topic):
    return stamps_in(folder / f'{folder.name}_0.mcap', topic)


def wait_for_more(bag, length, process):
    """Wait until the storage file has grown by so many bytes."""
    enough = size(bag) + length
    wait_until(lambda: size(bag) > enough, 'messages', 90.0, process)


@pytest.fixture(scope='module')
def live():
    """A plant beside an estimator, as long as the tests of this file run."""
    # The estimator first: it then sees every sample that the plant publishes.
    nodes = [start('estimator', *NODES), start('plant', *NODES)]
    yield nodes
    for node in nodes:
        interrupted(node)


def test_bag_is_complete_after_ctrl_c(live, tmp_path):
    bag = tmp_path / 'bag'
    process = start('record', '-o', bag, '--all')
    # Some six seconds; the estimator may be discovered later than the plant.
    wait_for_more(bag, 1_200_000, process)
    wait_until(lambda: len(stamps(bag, '/estimator/stamp')) > 20, 'estimates', 90.0, process)
    out, _ = interrupted(process)
    counts = {}
    latched = ('/rosout', *(f'/estimator/{name}' for name in (EVENT, SNAPSHOT, PARAMETERS)))
    information = yaml.safe_load((bag / 'metadata.yaml').read_text())
    for topic in information['rosbag2_bagfile_information']['topics_with_message_count']:
        metadata = topic['topic_metadata']
        name, qos = metadata['name'], metadata['offered_qos_profiles'][0]
        counts[name] = topic['message_count']
        assert qos['reliability'] == 'reliable'
        if name.startswith(('/estimator/', '/plant/', '/rosout')):  # not of other tests' nodes
            assert (qos['durability'] == 'transient_local') == (name in latched), name
    assert min(counts['/y'], counts['/plant/state']) > 1000
    assert {'/estimator/gamma', '/diagnostics', '/rosout'} <= set(counts)
    assert str(sum(counts.values())) in out
    read = dict.fromkeys(counts, 0)
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            read[connection.topic] += 1
    assert read == counts


def test_replay_follows_a_run_that_began_before_the_recording(live, tmp_path):
    """Through live changes and a reset, from a state that only the node knows."""
    bag = tmp_path / 'bag'
    process = start('record', '-o', bag)
    wait_for_more(bag, 800_000, process)
    with User('hand') as hand:
        parameters = Parameters(hand, '/estimator')
        parameters.set(epsilon=0.05, gamma_rate=0.008, unknown_input_decay=0.5)
        wait_for_more(bag, 100_000, process)  # half a second of messages to compare
        assert hand.call('/estimator/reset', Trigger, Trigger.Request()).success
        wait_for_more(bag, 100_000, process)
        parameters.set(epsilon=0.3)
        wait_for_more(bag, 200_000, process)
        _, error = interrupted(process)
        parameters.set(epsilon=40.0, gamma_rate=0.004, unknown_input_decay=0.0)
    assert 'lost' not in error
    command = ['replay', bag, '--params-file', ROOT / 'config' / 'demo.yaml']
    result = run(*command, '-o', tmp_path / 'out')
    assert result.returncode == 0, result.stderr
    [(same, count)] = re.findall(r'; (\d+) of (\d+) snapshots are the same', result.stdout)
    assert int(same) == int(count) > 3
    live = read_ticks(tmp_path / 'out', '/estimator', list(ESTIMATES))
    replayed = read_ticks(tmp_path / 'out', '/replay/estimator', list(ESTIMATES))
    there = live['stamp'] >= replayed['stamp'][0]
    assert there.sum() > 150
    row = np.searchsorted(replayed['stamp'], live['stamp'][there])
    for part in ESTIMATES:
        np.testing.assert_allclose(replayed[part][row], live[part][there], 1e-12, 1e-12)
    # What is fixed on the command line stays, whatever was changed live.
    fixed = run(*command, '-o', tmp_path / 'fixed', '-p', 'unknown_input_decay:=0.0')
    assert 'parameters differ' in fixed.stdout


def test_kill_leaves_what_was_flushed(live, tmp_path):
    bag = tmp_path / 'bag'
    process = start('record', '-o', bag, '--topics', '/y')
    wait_for_more(bag, 150_000, process)
    assert size(bag) < 1_000_000  # it is written before a chunk of 1 MiB is full
    killed = time.time_ns()
    process.kill()
    process.communicate(timeout=60)
    assert not (bag / 'metadata.yaml').exists()
    found = stamps(bag, '/y')
    assert len(found) > 1000
    assert killed - found[-1] < 20e9  # a busy machine; else half a second


def test_input_that_was_remapped_and_channels_are_recorded(tmp_path):
    bag = tmp_path / 'bag'
    channels = ['--ros-args', '-p', 'channels:=[hip, knee]', '-r', 'hip/y:=/force']
    apart = {'env': environment(ROS_DOMAIN_ID=APART)}
    processes = [
        start('record', '-o', bag, '--names', '/estimator', **apart),
        start('estimator', *channels, **apart),
        start('plant', '--ros-args', '-r', '/y:=/force', **apart),
    ]
    try:
        # It finds /force only as what the estimator listens to.
        wait_for_more(bag, 700_000, processes[0])
    finally:
        for process in reversed(processes):
            interrupted(process)
    with BagReader(bag) as reader:
        topics = {c.topic for c in reader.connections}
    assert '/knee/y' not in topics  # nobody publishes it
    chosen = ['-p', 'input_topic:=/force', '--follow', '/estimator/hip', '--name', '/replay/hip']
    result = run('replay', bag, '-o', tmp_path / 'out', *chosen)
    assert result.returncode == 0, result.stderr
    assert 'followed /estimator/hip' in result.stdout


def test_full_disk_leaves_what_was_recorded(live, tmp_path):
    """The system refuses to make a file larger than 150 kB."""
    command = ['record', '-o', str(tmp_path / 'bag'), '--topics', '/y']
    limited = f'ulimit -f 300; exec {" ".join(map(shlex.quote, [*COMMAND, *command]))}'
    result = subprocess.run(
        ['sh', '-c', limited], capture_output=True, text=True, timeout=120, env=environment(),
        check=False,
    )  # fmt: skip
    assert result.returncode == 2, result.stderr
    assert 'File "' not in result.stderr  # a stack, by Python or by the middleware
    assert '`mcap recover` saves what was recorded' in result.stderr
    assert len(stamps(tmp_path / 'bag', '/y')) > 1500
