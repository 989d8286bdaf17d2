# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: a node, or several, with a parameter file and arguments."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

ESTIMATOR = {
    'params_file': ('', 'YAML file of the estimator; empty: the defaults'),
    'name': ('estimator', 'name of the node'),
    'input_topic': ('', 'topic of y; empty: as the file says, else y'),
    'input_field': ('', 'number in its messages; empty: as the file says, else the only one'),
    'autostart': ('', 'false: a lifecycle manager activates the node; empty: as the file says'),
    'respawn': ('false', 'start the node again, after 2 s, if it ends'),
}
"""Arguments of an estimator: default and description by name."""
COMMON = {
    'namespace': ('', 'namespace of what is started'),
    'use_sim_time': ('', 'true: take the time from /clock; empty: as the file says'),
    'log_level': ('info', 'least severity that is logged'),
}
BOOLEAN = ['', 'true', 'false', 'True', 'False']
CHOICES = {
    'log_level': ['debug', 'info', 'warn', 'error', 'fatal'],
    **dict.fromkeys(('autostart', 'respawn', 'use_sim_time'), BOOLEAN),
}
"""Arguments that may have some values only."""
OF_LAUNCH = ('params_file', 'namespace', 'name', 'log_level', 'respawn')
"""Arguments that are no parameters of the node."""


def description(executables: list[str], arguments: Mapping[str, tuple[str, str]]) -> Any:
    """
    Return the launch description of nodes of this package; where one of several ends, all do.

    `arguments` are default and description by name, beside the common ones. Those that are not of
    launch are parameters of the nodes; one that is empty leaves its parameter to the file.
    """
    from launch import LaunchDescription  # not on PyPI, so not where it is not needed
    from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node

    arguments = {**arguments, **COMMON}

    def start(context: Any) -> list[Any]:
        given = {name: LaunchConfiguration(name).perform(context) for name in arguments}
        path = given['params_file']
        if path and not Path(path).is_file():  # launch would start the nodes with their defaults
            raise FileNotFoundError(f'params_file: expected a file, got {path}')
        values: dict[str, Any] = {k: v for k, v in given.items() if v and k not in OF_LAUNCH}
        for name in {'use_sim_time', 'autostart'} & set(values):
            values[name] = values[name].lower() == 'true'
        return [
            Node(
                package='fhaosmo_ros',
                executable=executable,
                name=given.get('name', executable),
                namespace=given['namespace'],
                parameters=[source for source in (path, values) if source],
                ros_arguments=['--log-level', given['log_level']],
                output='screen',
                emulate_tty=True,
                respawn=given.get('respawn', '').lower() == 'true',
                respawn_delay=2.0,
                on_exit=Shutdown(reason=f'{executable} ended') if executables[1:] else None,
            )
            for executable in executables
        ]

    declared = [
        DeclareLaunchArgument(
            name, default_value=default, description=text, choices=CHOICES.get(name)
        )
        for name, (default, text) in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def config(launch_file: str, name: str) -> str:
    """Return the path of a file in config/, which lies beside the folder of the launch file."""
    return str(Path(launch_file).absolute().parents[1] / 'config' / name)
