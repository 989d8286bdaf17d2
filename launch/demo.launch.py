# SPDX-License-Identifier: Apache-2.0
"""Start the simulated plant and the estimator with one parameter file."""

from fhaosmo_ros.launching import config, description
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """Return both nodes, and PlotJuggler if asked for; when one node ends, so does the launch."""
    found = description(
        ['plant', 'estimator'],
        {'params_file': (config(__file__, 'demo.yaml'), 'YAML file for both nodes')},
    )
    found.add_action(
        DeclareLaunchArgument(
            'plotjuggler',
            default_value='false',
            description='show the curves in PlotJuggler, which has to be installed',
        )
    )
    found.add_action(
        Node(
            package='plotjuggler',
            executable='plotjuggler',
            arguments=['--nosplash', '--layout', config(__file__, 'layouts/demo.plotjuggler.xml')],
            condition=IfCondition(LaunchConfiguration('plotjuggler')),
        )
    )
    return found
