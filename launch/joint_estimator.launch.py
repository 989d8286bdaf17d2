# SPDX-License-Identifier: Apache-2.0
"""Start an estimator of every joint of a JointState, by default with config/joint_states.yaml."""

from fhaosmo_ros.launching import config, description, ESTIMATOR


def generate_launch_description():
    """Return the arguments and the node."""
    return description(['estimator'], {
        **ESTIMATOR,
        'params_file': (config(__file__, 'joint_states.yaml'), 'YAML file'),
        'name': ('joint_estimator', 'name of the node'),
        'input_topic': ('', 'empty: as the file says (joint_states)'),
    })  # fmt: skip
