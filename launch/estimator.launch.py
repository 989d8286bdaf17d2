# SPDX-License-Identifier: Apache-2.0
"""Start an estimator with a parameter file, on a robot's own topic."""

from pathlib import Path

from fhaosmo_ros.launching import declared
from launch import LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    'params_file': ('', 'YAML file of the estimator; empty: the defaults'),
    'namespace': ('', 'namespace of the node'),
    'name': ('estimator', 'name of the node'),
    'input_topic': ('', 'topic of y; empty: as the file says, else y'),
    'input_field': ('', 'number in its messages; empty: as the file says, else the only one'),
    'use_sim_time': ('false', 'take the time from /clock'),
    'autostart': ('true', 'false: a lifecycle manager configures and activates the node'),
    'respawn': ('false', 'start the node again, after 2 s, if it ends'),
    'log_level': ('info', 'least severity that is logged'),
}


def start(context):
    """Return the node; an argument that is empty leaves the parameter to the file."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    path = given['params_file']
    if path and not Path(path).is_file():
        raise FileNotFoundError(f'params_file: expected a file, got {path}')
    values = {name: given[name].lower() == 'true' for name in ('use_sim_time', 'autostart')}
    values |= {name: given[name] for name in ('input_topic', 'input_field') if given[name]}
    return [
        Node(
            package='fhaosmo_ros',
            executable='estimator',
            name=given['name'],
            namespace=given['namespace'],
            parameters=[*([path] if path else []), values],
            ros_arguments=['--log-level', given['log_level']],
            output='screen',
            emulate_tty=True,
            respawn=given['respawn'].lower() == 'true',
            respawn_delay=2.0,
        )
    ]


def generate_launch_description():
    """Return the arguments and the node."""
    return LaunchDescription([*declared(ARGUMENTS), OpaqueFunction(function=start)])
