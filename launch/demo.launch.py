# SPDX-License-Identifier: Apache-2.0
"""Start the simulated plant and the estimator with one parameter file."""

from pathlib import Path

from fhaosmo_ros.launching import declared
from launch import LaunchDescription
from launch.actions import OpaqueFunction, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('fhaosmo_ros'), 'config'])
ARGUMENTS = {
    'params_file': (PathJoinSubstitution([CONFIG, 'demo.yaml']), 'YAML file for both nodes'),
    'namespace': ('', 'namespace of both nodes'),
    'use_sim_time': ('false', 'take the time from /clock'),
    'plotjuggler': ('false', 'show the curves in PlotJuggler, which has to be installed'),
    'log_level': ('info', 'least severity that is logged'),
}


def check_params_file(context):
    """Raise if the file does not exist; launch would start the nodes with their defaults."""
    path = Path(LaunchConfiguration('params_file').perform(context))
    if not path.is_file():
        raise FileNotFoundError(f'params_file: expected a file, got {path}')


def generate_launch_description():
    """Return both nodes; when one of them ends, so does the launch."""
    simulated = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    nodes = [
        Node(
            package='fhaosmo_ros',
            executable=name,
            name=name,
            namespace=LaunchConfiguration('namespace'),
            parameters=[LaunchConfiguration('params_file'), {'use_sim_time': simulated}],
            ros_arguments=['--log-level', LaunchConfiguration('log_level')],
            output='screen',
            emulate_tty=True,
            on_exit=Shutdown(reason=f'{name} ended'),
        )
        for name in ('plant', 'estimator')
    ]
    layout = PathJoinSubstitution([CONFIG, 'layouts', 'demo.plotjuggler.xml'])
    plotjuggler = Node(
        package='plotjuggler',
        executable='plotjuggler',
        arguments=['--nosplash', '--layout', layout],
        condition=IfCondition(LaunchConfiguration('plotjuggler')),
    )
    check = OpaqueFunction(function=check_params_file)
    return LaunchDescription([*declared(ARGUMENTS), check, *nodes, plotjuggler])
