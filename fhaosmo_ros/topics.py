# SPDX-License-Identifier: Apache-2.0
"""
The topics of estimator and plant, declared once: for the nodes, and for tools that read bags.

Message types are named as ROS names them, so that a tool without ROS can use them.
"""

from collections.abc import Mapping
from typing import Any

FLOAT = 'std_msgs/msg/Float64'
ARRAY = 'std_msgs/msg/Float64MultiArray'
TEXT = 'std_msgs/msg/String'
TIME = 'builtin_interfaces/msg/Time'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'

ESTIMATES = {
    'state': ARRAY,
    'unknown_input': FLOAT,
    'gamma': FLOAT,
    'innovation': ARRAY,
    'stamp': TIME,
}
"""Topics of an estimate below the estimator's name (and channel's), in order of publication."""
TYPED_ESTIMATES = {
    'joint_states': 'sensor_msgs/msg/JointState',
    'wrench': 'geometry_msgs/msg/WrenchStamped',
    'accel': 'geometry_msgs/msg/AccelStamped',
}
"""Topics below the estimator's name for those who want stamped messages, if asked for."""
STANDARD_DEVIATION = 'standard_deviation'
SELF_TUNED = {STANDARD_DEVIATION: ARRAY, 'tuning': ARRAY}
"""Further topics of a self-tuning estimator, with each estimate."""
EVENT = 'event'
"""Begin and end of each event (DIAGNOSTICS, transient-local), below its name and channel's."""
SNAPSHOT = 'snapshot'
"""All that an estimator remembers (ARRAY, transient-local), below its name and channel's."""
PARAMETERS = 'parameters'
"""Text of a parameter file (TEXT, transient-local), below the node's name."""
TRUTH = {'state': ARRAY, 'unknown_input': FLOAT}
"""Topics of the plant below its name: the truth that belongs to each sample of y."""
OF_ALL_NODES = {
    '/diagnostics': DIAGNOSTICS,
    '/rosout': 'rcl_interfaces/msg/Log',
    '/parameter_events': 'rcl_interfaces/msg/ParameterEvent',
}
"""Topics that all nodes of a system share."""


def estimates_of(parameters: Mapping[str, Any]) -> dict[str, str]:
    """Return topics of a channel whose QoS may be chosen, and their types, by its parameters."""
    tuned = SELF_TUNED if parameters['gains'] == 'self_tuning' else {}
    return ESTIMATES | tuned | {EVENT: DIAGNOSTICS}
