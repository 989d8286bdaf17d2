# SPDX-License-Identifier: Apache-2.0
"""
The topics of estimator and plant, declared once: for the nodes, and for tools that read bags.

Message types are named as ROS names them, so that a tool without ROS can use them.
"""

from collections.abc import Mapping
import re
from typing import Any

TOPIC_NAME = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)
FLOAT = 'std_msgs/msg/Float64'
ARRAY = 'std_msgs/msg/Float64MultiArray'
TEXT = 'std_msgs/msg/String'
TIME = 'builtin_interfaces/msg/Time'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'

STANDARD_DEVIATION = 'standard_deviation'
OF_GAINS = {
    'fixed': {'gamma': FLOAT},
    'self_tuning': {STANDARD_DEVIATION: ARRAY, 'tuning': ARRAY},
}
"""Topics that an estimator has by its parameter `gains`."""
ESTIMATES = {'state': ARRAY, 'unknown_input': FLOAT, 'innovation': ARRAY, 'stamp': TIME}
"""Topics that every estimator has below its name (and channel's); stamp is published last."""
TYPED_ESTIMATES = {
    'joint_states': 'sensor_msgs/msg/JointState',
    'wrench': 'geometry_msgs/msg/WrenchStamped',
    'accel': 'geometry_msgs/msg/AccelStamped',
}
"""Topics below the estimator's name for those who want stamped messages, if asked for."""
EVENT = 'event'
"""Begin and end of each event (DIAGNOSTICS, transient-local), below its name and channel's."""
SNAPSHOT = 'snapshot'
"""All that an estimator remembers (ARRAY, transient-local), below its name and channel's."""
PARAMETERS = 'parameters'
"""Text of a parameter file (TEXT, transient-local), below the node's name."""
TRUTH = {'state': ARRAY, 'unknown_input': FLOAT}
"""Topics of the plant below its name: the truth that belongs to each sample of y."""


def estimates_of(parameters: Mapping[str, Any]) -> dict[str, str]:
    """Return the topics of the estimates, and their types, in order of publication."""
    return OF_GAINS[parameters['gains']] | ESTIMATES
