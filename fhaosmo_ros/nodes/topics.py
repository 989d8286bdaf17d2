# SPDX-License-Identifier: Apache-2.0
"""The topics of a run of plant and estimator, with their types, and which of them are latched."""

from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log, ParameterEvent
from std_msgs.msg import Float64, Float64MultiArray, String

RUN_TOPICS = {
    '/y': Float64,
    '/plant/state': Float64MultiArray,
    '/plant/unknown_input': Float64,
    '/estimator/state': Float64MultiArray,
    '/estimator/unknown_input': Float64,
    '/estimator/gamma': Float64,
    '/estimator/innovation': Float64MultiArray,
    '/estimator/stamp': Time,
    '/estimator/snapshot': Float64MultiArray,
    '/estimator/parameters': String,
    '/diagnostics': DiagnosticArray,
    '/rosout': Log,
    '/parameter_events': ParameterEvent,
}
LATCHED = ('/estimator/snapshot', '/estimator/parameters')
"""Kept by their publisher for who comes late."""


def type_name(message_type: Any) -> str:
    """Return the ROS name of a message class, such as 'std_msgs/msg/Float64'."""
    package = message_type.__module__.split('.')[0]
    return f'{package}/msg/{message_type.__name__}'
