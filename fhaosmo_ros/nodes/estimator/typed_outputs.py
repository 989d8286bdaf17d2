# SPDX-License-Identifier: Apache-2.0
"""Estimates as the stamped messages that robots use: JointState, WrenchStamped, AccelStamped."""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.estimates import Estimate
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.endpoints import DEPTH, has_listeners
from fhaosmo_ros.nodes.middleware.messages import message_class, time_message
from fhaosmo_ros.topics import TYPED_ESTIMATES
from geometry_msgs.msg import AccelStamped, WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState


class Output(NamedTuple):
    """The latest estimate of a channel, with its parameters and the stamp of its sample (ns)."""

    name: str
    stamp: int
    estimate: Estimate
    values: Mapping[str, Any]

    @property
    def effort(self) -> float:
        """The unknown input in the user's unit."""
        return float(self.estimate.unknown_input * self.values['unknown_input_scale'])


class TypedOutputs:
    """Publishers of the messages that ``typed_outputs`` asks for, each for all channels."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._frame: str = values['frame_id']
        self._publishers = {
            name: node.create_publisher(message_class(TYPED_ESTIMATES[name]), f'~/{name}', DEPTH)
            for name in dict.fromkeys(values['typed_outputs'])
            if name != 'none'
        }

    def publish(self, outputs: Sequence[Output]) -> None:
        """Publish the latest estimates of some channels, with the latest of their stamps."""
        for name, publisher in self._publishers.items():
            if has_listeners(publisher):
                message = MAKERS[name](outputs)
                message.header.frame_id = self._frame
                message.header.stamp = time_message(max(o.stamp for o in outputs))
                publisher.publish(message)


def _joint_states(outputs: Sequence[Output]) -> JointState:
    states = [output.estimate.z for output in outputs]
    return JointState(
        name=[output.name for output in outputs],
        position=[float(z[0]) for z in states],
        velocity=[float(z[1]) if len(z) > 1 else nan for z in states],
        effort=[output.effort for output in outputs],
    )


def _wrench(outputs: Sequence[Output]) -> WrenchStamped:
    message = WrenchStamped()
    vectors = {'linear': message.wrench.force, 'angular': message.wrench.torque}
    for output in outputs:
        vector, axis = output.values['output_axis'].split('.')
        setattr(vectors[vector], axis, output.effort)
    return message


def _accel(outputs: Sequence[Output]) -> AccelStamped:
    message = AccelStamped()
    for output in outputs:
        vector, axis = output.values['output_axis'].split('.')
        setattr(getattr(message.accel, vector), axis, float(output.estimate.unknown_input))
    return message


MAKERS = {'joint_states': _joint_states, 'wrench': _wrench, 'accel': _accel}


def check_axes(typed_outputs: Sequence[str], channels: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise ConfigurationError if two channels would write to the same axis of a message."""
    if not {'wrench', 'accel'} & set(typed_outputs):
        return
    taken: dict[str, str] = {}
    for name, values in channels.items():
        axis = values['output_axis']
        if axis in taken:
            raise ConfigurationError(
                f"parameter 'output_axis': expected another axis for each channel, got {axis!r} "
                f'for {taken[axis]} and for {name}'
            )
        taken[axis] = name
