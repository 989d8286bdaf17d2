# SPDX-License-Identifier: Apache-2.0
"""Start the arm node with a parameter file, on a robot's own topics."""

from fhaosmo_ros.launching import config, description


def generate_launch_description():
    """Return the arguments and the node."""
    return description(['arm'], {
        'params_file': (config(__file__, 'arm.yaml'), 'YAML file of the node'),
        'robot_description_file': ('', 'URDF; empty: the topic robot_description'),
        'calibration_file': ('', 'file of `calibrate`; empty: as the file says'),
    })  # fmt: skip
