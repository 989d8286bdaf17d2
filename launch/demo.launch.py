# SPDX-License-Identifier: Apache-2.0
"""Start the simulated plant and the estimator with one parameter file."""

from fhaosmo_ros.launching import config, description


def generate_launch_description():
    """Return both nodes; when one of them ends, so does the launch."""
    return description(['plant', 'estimator'], {
        'params_file': (config(__file__, 'demo.yaml'), 'YAML file for both nodes'),
    })  # fmt: skip
