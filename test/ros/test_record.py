# SPDX-License-Identifier: Apache-2.0
"""The commands record, play and demo beside live nodes: complete bags, and no process left."""

from contextlib import suppress
import os
import re
import shlex
import signal

import bag_files as files
from commands import COMMAND, environment, ROOT, run, start, take_domain, wait_until
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.tools import demo
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.recorded import read_ticks
from fhaosmo_ros.topics import ESTIMATES, EVENT, PARAMETERS, SNAPSHOT
from mcap.reader import NonSeekingReader
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_msg
from running import Parameters
from std_srvs.srv import Trigger
import yaml

APART = {'env': environment(ROS_DOMAIN_ID=str(take_domain()))}
"""For a domain without the plant that the other tests share."""
FILE = ['--params-file', ROOT / 'config' / 'demo.yaml']


def size(folder):
    """Bytes of the storage file, 0 while there is none."""
    file = folder / f'{folder.name}_0.mcap'
    return file.stat().st_size if file.exists() else 0


def stamps(folder, topic):
    """Stamps of a topic in a storage file that is not complete: it grows, or was cut."""
    found = []
    with suppress(Exception), (folder / f'{folder.name}_0.mcap').open('rb') as file:
        for _, _, message in NonSeekingReader(file).iter_messages([topic], log_time_order=False):
            found.append(message.log_time)
    return found


def wait_for_more(bag, length, process):
    """Wait until the storage file has grown by so many bytes."""
    enough = size(bag) + length
    wait_until(lambda: size(bag) > enough, 'messages', 90.0, process)


@pytest.fixture(scope='module')
def live(launch):
    """A plant beside an estimator, as long as the tests of this file run."""
    # The estimator first: it then sees every sample that the plant publishes.
    return launch('estimator', *FILE), launch('plant', *FILE)


def test_bag_is_complete_after_ctrl_c(live, launch, tmp_path):
    bag = tmp_path / 'bag'
    process = launch('record', '--', '-o', bag, '--all')
    # Some six seconds; the estimator may be discovered later than the plant.
    wait_for_more(bag, 1_200_000, process)
    wait_until(lambda: len(stamps(bag, '/estimator/stamp')) > 20, 'estimates', 90.0, process)
    out, counts = process.stop(), {}
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


def test_replay_follows_a_run_that_began_before_the_recording(live, user, launch, tmp_path):
    """Through live changes and a reset, from a state that only the node knows."""
    bag = tmp_path / 'bag'
    process = launch('record', '--', '-o', bag)
    wait_for_more(bag, 800_000, process)
    parameters = Parameters(user, '/estimator')
    parameters.set(epsilon=0.05, gamma_rate=0.008, unknown_input_decay=0.5)
    wait_for_more(bag, 100_000, process)  # half a second of messages to compare
    assert user.call('/estimator/reset', Trigger).success
    wait_for_more(bag, 100_000, process)
    parameters.set(epsilon=0.3)
    wait_for_more(bag, 200_000, process)
    assert 'lost' not in process.stop()
    parameters.set(epsilon=40.0, gamma_rate=0.004, unknown_input_decay=0.0)
    command = ['replay', bag, *FILE]
    result = run(*command, '-o', tmp_path / 'out')
    assert result.returncode == 0, result.stderr
    [(same, count)] = re.findall(r'; (\d+) of (\d+) snapshots are the same', result.stdout)
    assert int(same) == int(count) > 3
    with BagReader(tmp_path / 'out') as reader:
        live = read_ticks(reader, '/estimator', list(ESTIMATES))
        replayed = read_ticks(reader, '/replay/estimator', list(ESTIMATES))
    there = live['stamp'] >= replayed['stamp'][0]
    assert there.sum() > 150
    row = np.searchsorted(replayed['stamp'], live['stamp'][there])
    for part in ESTIMATES:
        np.testing.assert_allclose(replayed[part][row], live[part][there], 1e-12, 1e-12)
    # What is fixed on the command line stays, whatever was changed live.
    fixed = run(*command, '-o', tmp_path / 'fixed', '-p', 'unknown_input_decay:=0.0')
    assert 'parameters differ' in fixed.stdout


def test_input_that_was_remapped_and_channels_are_recorded(launch, tmp_path):
    bag = tmp_path / 'bag'
    recorder = launch('record', '--', '-o', bag, '--names', '/rig/estimator')
    launch('estimator', '-r', 'hip/y:=/force', namespace='/rig', channels=['hip', 'knee'])
    launch('plant', '-r', 'y:=/force', namespace='/rig')
    # It finds /force only as what the estimator listens to.
    wait_for_more(bag, 700_000, recorder)
    recorder.stop()
    with BagReader(bag) as reader:
        topics = {c.topic for c in reader.connections}
    assert '/rig/knee/y' not in topics  # nobody publishes it
    name = '/rig/estimator/hip'
    chosen = ['-p', 'input_topic:=/force', '--channel', 'hip', '--name', '/replay/hip']
    result = run('replay', bag, '-o', tmp_path / 'out', *chosen)
    assert result.returncode == 0, result.stderr
    assert f'followed {name}' in result.stdout


def test_full_disk_leaves_what_was_recorded(live, tmp_path):
    """The system refuses to make a file larger than 150 kB."""
    command = ['record', '-o', str(tmp_path / 'bag'), '--topics', '/y']
    limited = f'ulimit -f 300; exec {" ".join(map(shlex.quote, [*COMMAND, *command]))}'
    result = run('-c', limited, command=['sh'])
    assert result.returncode == 2, result.stderr
    assert 'File "' not in result.stderr  # a stack, by Python or by the middleware
    assert '`mcap recover` saves what was recorded' in result.stderr
    # Written before a chunk of 1 MiB is full: a kill leaves as much.
    assert len(stamps(tmp_path / 'bag', '/y')) > 1500


def test_bag_is_played_in_its_own_time_and_an_estimator_restarts_with_the_next(launch, tmp_path):
    """With names, remappings and the arguments that launch adds, also those without a meaning."""
    remapped = (
        '-r', '__ns:=/tools', '-r', '/y:=/rig/y', '--log-level', 'warn',
        '-p', 'use_sim_time:=true', '--params-file', tmp_path / 'none.yaml',
    )  # fmt: skip
    (tmp_path / 'none.yaml').write_text('none: {ros__parameters: {}}')
    files.TYPES.register(get_types_from_msg('float64 data', 'planted_msgs/msg/Thing'))
    stamps, y = files.signal(1000)
    thing = '/x', 'planted_msgs/msg/Thing', int(stamps[-1]), files.float64(1.0)
    files.write(tmp_path / 'bag', [*files.floats(stamps, y), thing])
    recorder = launch('record', *remapped, '--', '-o', tmp_path / 'out', '--topics', '/y')
    clock = {'use_sim_time': True, 'sampling': 'clock'}
    estimator = launch('estimator', namespace='/again', input_topic='/rig/y', **clock)
    for _ in range(2):
        played = run('play', tmp_path / 'bag', '--ros-args', *remapped)
        assert played.returncode == 0
    wait_until(lambda: '1 restarts: stamps jumped' in estimator.output(), 'restart', 300.0)
    wait_until(lambda: size(tmp_path / 'out') > 50_000, 'messages')
    recorder.stop()
    assert 'not played: /x: planted_msgs/msg/Thing is not installed' in played.stderr
    assert run('play', tmp_path / 'bag', '--topics', '/x').returncode == 2
    assert 'playing 1 topics' in played.stdout
    with BagReader(tmp_path / 'out') as reader:
        times = np.array([time for _, time, _, _ in reader.messages(['/rig/y'])])
    second = 1 + np.argmax(np.diff(times))  # the first message of the second run
    # However play is held up, it publishes nothing early: the last message not before 1 s.
    assert max(np.ptp(times[:second]), np.ptp(times[second:])) > 500_000_000


def test_only_installed_message_types_have_a_class(tmp_path, monkeypatch):
    """Names in a bag come from strangers: no other package that has such a name is imported."""
    assert message_class('std_msgs/msg/Float64').__name__ == 'Float64'
    site_packages = tmp_path / 'install' / 'lib' / 'python3' / 'site-packages'
    package, mark = site_packages / 'workspace_msgs', tmp_path / 'imported'
    (package / 'msg').mkdir(parents=True)
    (package / '__init__.py').write_text(f"open({str(mark)!r}, 'w').close()\n")
    (package / 'msg' / '__init__.py').write_text('class Thing:\n    pass\n')
    monkeypatch.syspath_prepend(site_packages)
    for name in ('workspace_msgs/msg/Thing', 'std_msgs/msg/Nothing', 'os/msg/Path', ''):
        with pytest.raises(LookupError, match='expected a message type that is installed here'):
            message_class(name)
    assert not mark.exists()
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{tmp_path / "install"}{os.pathsep}')
    assert message_class('workspace_msgs/msg/Thing').__name__ == 'Thing'
    assert mark.exists()


def expect_no_process(process):
    """Expect that all processes of its session have ended."""
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


def test_run_leaves_a_report_a_figure_and_a_bag_but_no_process(tmp_path):
    """With the second engine: what it has found is in the bag, and there is no power."""
    folder = tmp_path / 'out'
    process = start('demo', '--duration', 9, '--output', folder, '--self-tuning', **APART)
    out, err = process.communicate(timeout=400)
    assert process.returncode == 0, err
    expect_no_process(process)
    for word in ('RMS error', 'z1', 'z2', 'z3', 'now with noise of 1e-4 on y'):
        assert word in out
    assert (folder / 'report.txt').read_text().strip() in out
    with AnyReader([folder / 'bag']) as reader:
        topics = {c.topic for c in reader.connections}
    found = [f'/estimator/{part}' for part in (*ESTIMATES, 'tuning', SNAPSHOT, PARAMETERS)]
    assert {'/y', '/plant/state', '/plant/unknown_input', *found} <= topics
    (live,) = demo.observers(folder / 'bag', {'gains': 'self_tuning'})
    assert len(live.stamps) > 300
    assert live.gamma is None
    late = live.stamps > live.stamps[0] + 3_000_000_000
    # Not d: other tests load the machine meanwhile, and its stamps jitter in bursts then.
    error = np.median(np.abs(live.estimate - live.truth)[late, :2], axis=0)
    assert (error < 0.05 * np.abs(live.truth[late, :2]).max(axis=0)).all()


def test_ctrl_c_ends_early_with_a_report_and_without_a_trace(tmp_path):
    folder = tmp_path / 'out'
    process = start('demo', '--duration', 600, '--output', folder, **APART)

    def count():
        return sum(len(stamps(b, '/estimator/state')) for b in tmp_path.glob('out.*/out/bag'))

    wait_until(lambda: count() > 100, 'estimates', 120.0, process)
    # As a terminal does: to the whole group; and twice, as an impatient user does.
    os.killpg(process.pid, signal.SIGINT)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert 'Traceback' not in err
    assert 'stopped early' in out
    assert all(name in out for name in demo.OTHERS)
    assert (folder / 'demo.png').read_bytes()[:8] == b'\x89PNG\r\n\x1a\n'
    expect_no_process(process)


def test_a_start_that_takes_too_long_says_what_is_missing(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv('ROS_DOMAIN_ID', APART['env']['ROS_DOMAIN_ID'])
    monkeypatch.setattr(demo, 'START_DEADLINE', 0.0)
    assert demo.main(['--output', str(tmp_path / 'out')]) == 2
    assert 'waited 0 s in vain for /y (0 publishers), /plant/state' in capfd.readouterr().err


def test_another_plant_in_the_same_domain_is_refused(live, tmp_path):
    """The bag would hold the samples and estimates of both."""
    result = run('demo', '--duration', 600, '--output', tmp_path / 'out')
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}' in result.stderr
    assert list(tmp_path.iterdir()) == []
