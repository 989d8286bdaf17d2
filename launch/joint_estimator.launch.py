# SPDX-License-Identifier: Apache-2.0
"""Start an estimator of every joint of a JointState, by default with config/joint_states.yaml."""

from fhaosmo_ros.launching import declared
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('fhaosmo_ros')
ARGUMENTS = {
    'params_file': (PathJoinSubstitution([SHARE, 'config', 'joint_states.yaml']), 'YAML file'),
    'namespace': ('', 'namespace of the node'),
    'name': ('joint_estimator', 'name of the node'),
    'input_topic': ('', 'empty: as the file says (joint_states)'),
    'use_sim_time': ('false', 'take the time from /clock'),
    'log_level': ('info', 'least severity that is logged'),
}


def generate_launch_description():
    """Return estimator.launch.py with the defaults for joints."""
    source = PythonLaunchDescriptionSource(
        PathJoinSubstitution([SHARE, 'launch', 'estimator.launch.py'])
    )
    passed_on = {name: LaunchConfiguration(name) for name in ARGUMENTS}.items()
    include = IncludeLaunchDescription(source, launch_arguments=passed_on)
    return LaunchDescription([*declared(ARGUMENTS), include])
