# SPDX-License-Identifier: Apache-2.0
"""Start the arm node with a parameter file, on a robot's own topics."""

from pathlib import Path

from fhaosmo_ros.launching import declared
from launch import LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('fhaosmo_ros')
ARGUMENTS = {
    'params_file': (PathJoinSubstitution([SHARE, 'config', 'arm.yaml']), 'YAML file of the node'),
    'namespace': ('', 'namespace of the node'),
    'robot_description_file': ('', 'URDF; empty: the topic robot_description'),
    'calibration_file': ('', 'file of `calibrate`; empty: as the file says'),
    'use_sim_time': ('false', 'take the time from /clock'),
    'log_level': ('info', 'least severity that is logged'),
}


def start(context):
    """Return the node; an argument that is empty leaves the parameter to the file."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if not Path(given['params_file']).is_file():
        raise FileNotFoundError(f'params_file: expected a file, got {given["params_file"]}')
    values = {'use_sim_time': given['use_sim_time'].lower() == 'true'}
    for name in ('robot_description_file', 'calibration_file'):
        if given[name]:
            values[name] = given[name]
    return [
        Node(
            package='fhaosmo_ros',
            executable='arm',
            name='arm',
            namespace=given['namespace'],
            parameters=[given['params_file'], values],
            ros_arguments=['--log-level', given['log_level']],
            output='screen',
            emulate_tty=True,
        )
    ]


def generate_launch_description():
    """Return the arguments and the node."""
    return LaunchDescription([*declared(ARGUMENTS), OpaqueFunction(function=start)])
