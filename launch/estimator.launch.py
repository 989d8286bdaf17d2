# SPDX-License-Identifier: Apache-2.0
"""Start an estimator with a parameter file, on a robot's own topic."""

from fhaosmo_ros.launching import description, ESTIMATOR


def generate_launch_description():
    """Return the arguments and the node."""
    return description(['estimator'], ESTIMATOR)
