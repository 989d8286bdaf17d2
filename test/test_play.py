# SPDX-License-Identifier: Apache-2.0
"""A live estimator in simulation time, and a recorder, against a recording that is played."""

import os

import pytest
from rosbags.typesys import get_types_from_msg

pytest.importorskip('rclpy', reason='no ROS 2 in this Python')

import bag_files as files
from commands import interrupted, start
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.tools.bags.reader import BagReader
from waiting import wait_until

pytestmark = pytest.mark.ros


def plant_package(folder, name):
    """Write a package of messages whose import leaves a file; return that file."""
    mark = folder / 'imported'
    (folder / name / 'msg').mkdir(parents=True)
    (folder / name / '__init__.py').write_text(f"open({str(mark)!r}, 'w').close()\n")
    (folder / name / 'msg' / '__init__.py').write_text('class Thing:\n    pass\n')
    return mark


def test_bag_is_played_in_its_own_time_and_an_estimator_restarts_where_it_begins_again(tmp_path):
    """With names, remappings and the arguments that launch adds, also those without a meaning."""
    remapped = (
        '--ros-args', '-r', '__ns:=/tools', '-r', '/y:=/rig/y', '--log-level', 'warn',
        '-p', 'use_sim_time:=true', '--params-file', tmp_path / 'none.yaml',
    )  # fmt: skip
    (tmp_path / 'none.yaml').write_text('none: {ros__parameters: {}}')
    # The names in a bag come from strangers: a package beside it is not imported.
    mark = plant_package(tmp_path, 'planted_msgs')
    files.TYPES.register(get_types_from_msg('float64 data', 'planted_msgs/msg/Thing'))
    stamps, y = files.signal(1000)
    thing = '/x', 'planted_msgs/msg/Thing', int(stamps[-1]), files.float64(1.0)
    files.write(tmp_path / 'bag', [*files.floats(stamps, y), thing])
    log, recorded = tmp_path / 'log', tmp_path / 'out' / 'out_0.mcap'
    clock = ('--ros-args', '-p', 'use_sim_time:=true', '-p', 'sampling:=clock')
    with log.open('w') as output:
        processes = [
            start('play', 'bag', '--loop', '--delay', '0', *remapped, cwd=tmp_path),
            start('record', '-o', 'out', '--topics', '/y', *remapped, cwd=tmp_path),
            start('estimator', *clock, '-p', 'input_topic:=/rig/y', stdout=output, stderr=output),
        ]
    try:
        wait_until(lambda: 'restarted from the new one' in log.read_text(), 'restart', 300.0)
        wait_until(lambda: recorded.exists() and recorded.stat().st_size > 50_000, 'messages')
    finally:
        said = [interrupted(process)[0] for process in processes]
    assert 'not played: /x: planted_msgs/msg/Thing is not installed here' in said[0]
    assert 'playing 1 topics' in said[0]
    assert not mark.exists()
    with BagReader(tmp_path / 'out') as reader:
        times = [time for _, time, _, _ in reader.messages(['/rig/y'])]
    assert (times[-1] - times[0]) / len(times) > 200_000  # 1 ms, less what play was held up


def test_only_installed_message_types_have_a_class(tmp_path, monkeypatch):
    assert message_class('std_msgs/msg/Float64').__name__ == 'Float64'
    site_packages = tmp_path / 'install' / 'lib' / 'python3' / 'site-packages'
    mark = plant_package(site_packages, 'workspace_msgs')
    monkeypatch.syspath_prepend(site_packages)
    for name in ('workspace_msgs/msg/Thing', 'std_msgs/msg/Nothing', 'os/msg/Path', ''):
        with pytest.raises(LookupError, match='expected a message type that is installed here'):
            message_class(name)
    assert not mark.exists()
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{tmp_path / "install"}{os.pathsep}')
    assert message_class('workspace_msgs/msg/Thing').__name__ == 'Thing'
    assert mark.exists()
