# SPDX-License-Identifier: Apache-2.0
"""A live estimator in simulation time, and a recorder, against a recording that is played."""

import os
import subprocess
import time

import pytest
from rosbags.typesys import get_types_from_msg

pytest.importorskip('rclpy', reason='no ROS 2 in this Python')

import bag_files as files
from commands import interrupted, start
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.tools.bags.reader import BagReader
from waiting import wait_until

pytestmark = pytest.mark.ros


def play(*arguments, **options):
    """Start a command; what it says on stderr is with its output."""
    return start(*arguments, stderr=subprocess.STDOUT, **options)


def test_estimator_restarts_where_the_loop_begins_again(tmp_path):
    """With names, remappings and the arguments that launch adds, also those without a meaning."""
    bag = files.write(tmp_path / 'bag', files.floats(*files.signal(1000)))
    remapped = (
        '--ros-args', '-r', '__ns:=/tools', '-r', '/y:=/rig/y', '--log-level', 'warn',
        '-p', 'use_sim_time:=true', '--params-file', tmp_path / 'none.yaml',
    )  # fmt: skip
    (tmp_path / 'none.yaml').write_text('none: {ros__parameters: {}}')
    log, recorded = tmp_path / 'log', tmp_path / 'out' / 'out_0.mcap'
    with log.open('w') as output:
        processes = [
            play('play', bag, '--loop', '--delay', '0', *remapped),
            play(
                'record', '-o', tmp_path / 'out', '--topics', '/y', *remapped,
                '-r', '__node:=scribe',
            ),
            play(
                'estimator', '--ros-args', '-p', 'use_sim_time:=true', '-p', 'sampling:=clock',
                '-p', 'input_topic:=/rig/y', stdout=output,
            ),
        ]  # fmt: skip
    try:
        wait_until(lambda: 'restarted from the new one' in log.read_text(), 'restart', 300.0)
        wait_until(lambda: recorded.exists() and recorded.stat().st_size > 20_000, 'messages')
    finally:
        for process in processes:
            interrupted(process)
    with BagReader(tmp_path / 'out') as reader:
        assert reader.count('/rig/y') > 0


def plant_package(folder, name):
    """Write a package of messages whose import leaves a file; return that file."""
    mark = folder / 'imported'
    (folder / name / 'msg').mkdir(parents=True)
    (folder / name / '__init__.py').write_text(f"open({str(mark)!r}, 'w').close()\n")
    (folder / name / 'msg' / '__init__.py').write_text('class Thing:\n    pass\n')
    return mark


def test_bag_takes_its_own_time_and_imports_no_package_beside_it(tmp_path):
    """The names in a bag come from strangers."""
    mark = plant_package(tmp_path, 'planted_msgs')
    files.TYPES.register(get_types_from_msg('float64 data', 'planted_msgs/msg/Thing'))
    stamps, y = files.signal(4000)
    things = [('/x', 'planted_msgs/msg/Thing', int(stamps[20]), files.float64(1.0))]
    files.write(tmp_path / 'bag', [*files.floats(stamps, y), *things])
    process = play('play', 'bag', '--delay', '0', cwd=tmp_path)
    said = ''
    while 'playing' not in said:
        said = process.stdout.readline()
        assert process.poll() is None
        if 'not played' in said:
            assert '/x: planted_msgs/msg/Thing is not installed here' in said
    assert 'playing 1 topics' in said
    begin = time.monotonic()
    process.communicate(timeout=120)
    assert process.returncode == 0
    assert time.monotonic() - begin > 2.0  # 4 s, less what this test is held up
    assert not mark.exists()


def test_only_installed_message_types_have_a_class(tmp_path, monkeypatch):
    assert message_class('std_msgs/msg/Float64').__name__ == 'Float64'
    site_packages = tmp_path / 'install' / 'lib' / 'python3' / 'site-packages'
    mark = plant_package(site_packages, 'workspace_msgs')
    monkeypatch.syspath_prepend(site_packages)
    names = ['workspace_msgs/msg/Thing', 'std_msgs/msg/Nothing', 'std_msgs/srv/Float64',
             'os/msg/Path', 'std_msgs.msg/msg/Float64', 'numpy/msg/Thing', '']  # fmt: skip
    for name in names:
        with pytest.raises(LookupError, match='expected a message type that is installed here'):
            message_class(name)
    assert not mark.exists()
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{tmp_path / "install"}{os.pathsep}')
    assert message_class('workspace_msgs/msg/Thing').__name__ == 'Thing'
    assert mark.exists()
