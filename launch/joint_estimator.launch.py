# SPDX-License-Identifier: Apache-2.0
"""Start an estimator of every joint of a JointState, by default with config/joint_states.yaml."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

PASSED_ON = ('params_file', 'namespace', 'name', 'input_topic', 'use_sim_time', 'log_level')


def generate_launch_description():
    """Return estimator.launch.py with the defaults for joints."""
    share = FindPackageShare('fhaosmo_ros')
    defaults = PathJoinSubstitution([share, 'config', 'joint_states.yaml'])
    arguments = [
        DeclareLaunchArgument('params_file', default_value=defaults, description='YAML file'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the node'),
        DeclareLaunchArgument(
            'name', default_value='joint_estimator', description='name of the node'
        ),
        DeclareLaunchArgument(
            'input_topic', default_value='', description='empty: as the file says (joint_states)'
        ),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', description='take the time from /clock'
        ),
        DeclareLaunchArgument(
            'log_level', default_value='info', description='least severity that is logged'
        ),
    ]
    estimator = PathJoinSubstitution([share, 'launch', 'estimator.launch.py'])
    return LaunchDescription(
        [
            *arguments,
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(estimator),
                launch_arguments={name: LaunchConfiguration(name) for name in PASSED_ON}.items(),
            ),
        ]
    )
