# SPDX-License-Identifier: Apache-2.0
"""Start the simulated plant and the estimator with one parameter file."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory, PackageNotFoundError
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def check_params_file(context):
    """Raise if the file does not exist; launch would start the nodes with their defaults."""
    path = Path(LaunchConfiguration('params_file').perform(context))
    if not path.is_file():
        raise FileNotFoundError(f'params_file: expected a file, got {path}')


def end(event, context):
    """
    End the launch with a node; raise, so that it exits with an error, if the node failed.

    With `respawn`, launch starts a node that failed again, but not one that was ended by a signal
    (exit code 0) or refuses its parameters (2).
    """
    respawn = LaunchConfiguration('respawn').perform(context) == 'true'
    if respawn and event.returncode not in (0, 2):
        return None
    if event.returncode:
        raise RuntimeError(f'{event.process_name} ended with exit code {event.returncode}')
    return Shutdown(reason=f'{event.process_name} ended')


def plotjuggler(context):
    """Return PlotJuggler with the layout of the demonstration, where it is asked for."""
    if LaunchConfiguration('plotjuggler').perform(context) != 'true':
        return []
    try:
        get_package_share_directory('plotjuggler')
    except PackageNotFoundError:
        raise RuntimeError(
            'plotjuggler:=true: expected the package plotjuggler, which is not installed '
            '(sudo apt install ros-jazzy-plotjuggler-ros)'
        ) from None
    share = get_package_share_directory('fhaosmo_ros')
    layout = str(Path(share) / 'config' / 'layouts' / 'demo.plotjuggler.xml')
    return [
        Node(
            package='plotjuggler',
            executable='plotjuggler',
            arguments=['--nosplash', '--layout', layout],
        )
    ]


def generate_launch_description():
    """Return both nodes; when one of them ends, so does the launch."""
    defaults = PathJoinSubstitution([FindPackageShare('fhaosmo_ros'), 'config', 'demo.yaml'])
    arguments = [
        DeclareLaunchArgument(
            'params_file', default_value=defaults, description='YAML file for both nodes'
        ),
        DeclareLaunchArgument(
            'namespace', default_value='', description='namespace of both nodes'
        ),
        DeclareLaunchArgument(
            'use_sim_time',
            default_value='false',
            choices=['true', 'false'],
            description='take the time from /clock',
        ),
        DeclareLaunchArgument(
            'autostart',
            default_value='true',
            choices=['true', 'false'],
            description='false: a lifecycle manager configures and activates the estimator',
        ),
        DeclareLaunchArgument(
            'respawn',
            default_value='false',
            choices=['true', 'false'],
            description='start a node that failed again, after 2 s',
        ),
        DeclareLaunchArgument(
            'plotjuggler',
            default_value='false',
            choices=['true', 'false'],
            description='show the curves in PlotJuggler, if it is installed',
        ),
        DeclareLaunchArgument(
            'log_level',
            default_value='info',
            choices=['debug', 'info', 'warn', 'error', 'fatal'],
            description='least severity that is logged',
        ),
    ]
    # Later entries win, but only over the wildcard keys (/**) that the shipped YAML uses: a
    # section named after a node would beat them here. The plant passes over what is not its own.
    switches = {
        name: ParameterValue(LaunchConfiguration(name), value_type=bool)
        for name in ('use_sim_time', 'autostart')
    }
    nodes = [
        Node(
            package='fhaosmo_ros',
            executable=name,
            name=name,
            namespace=LaunchConfiguration('namespace'),
            parameters=[LaunchConfiguration('params_file'), switches],
            ros_arguments=['--log-level', LaunchConfiguration('log_level')],
            output='screen',
            emulate_tty=True,
            on_exit=end,
            respawn=LaunchConfiguration('respawn'),
            respawn_delay=2.0,  # where `end` ends the launch, no node starts in this time
        )
        for name in ('plant', 'estimator')
    ]
    checks = [OpaqueFunction(function=check_params_file), OpaqueFunction(function=plotjuggler)]
    return LaunchDescription([*arguments, *checks, *nodes])
