# SPDX-License-Identifier: Apache-2.0
"""Estimates as the stamped messages that robots use: JointState, WrenchStamped, AccelStamped."""

from array import array
from collections.abc import Callable, Mapping, Sequence
from math import nan
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.estimates import Estimate
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.messages import message_class, time_message
from fhaosmo_ros.nodes.middleware.publishers import DEPTH, listeners_of
from fhaosmo_ros.topics import TYPED_ESTIMATES
from geometry_msgs.msg import AccelStamped, Vector3, WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState


class Output(NamedTuple):
    """The latest estimate of a channel, with its parameters and the stamp of its sample (ns)."""

    name: str
    stamp: int
    estimate: Estimate
    values: Mapping[str, Any]


class TypedOutputs:
    """
    Publishers of the messages that ``typed_outputs`` asks for, each for all channels of a node.

    Parameters
    ----------
    node : Node
    values : mapping
        Parameters of the node.

    """

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node = node
        self._frame: str = values['frame_id']
        makers: dict[str, Callable[[Sequence[Output]], Any]] = {
            'joint_states': self._joint_states, 'wrench': self._wrench, 'accel': self._accel,
        }  # fmt: skip
        self._publishers: list[Any] = []
        self._parts = []
        for name in dict.fromkeys(values['typed_outputs']):
            if name != 'none':
                kind = message_class(TYPED_ESTIMATES[name])
                publisher = node.create_publisher(kind, f'~/{name}', QoSProfile(depth=DEPTH))
                self._publishers.append(publisher)
                self._parts.append((listeners_of(publisher), publisher.publish, makers[name]))

    def publish(self, outputs: Sequence[Output]) -> None:
        """Publish the latest estimates of some channels, with the latest of their stamps."""
        for listeners, publish, make in self._parts:
            if listeners():
                message = make(outputs)
                message.header.frame_id = self._frame
                message.header.stamp = time_message(max(o.stamp for o in outputs))
                publish(message)

    def destroy(self) -> None:
        """Take the publishers away."""
        self._parts = []
        while self._publishers:
            self._node.destroy_publisher(self._publishers.pop())

    @staticmethod
    def _joint_states(outputs: Sequence[Output]) -> JointState:
        numbers = [
            (e.z[0], e.z[1] if len(e.z) > 1 else nan, e.unknown_input * v['unknown_input_scale'])
            for _, _, e, v in outputs
        ]
        position, velocity, effort = (array('d', column) for column in zip(*numbers, strict=True))
        names = [output.name for output in outputs]
        return JointState(name=names, position=position, velocity=velocity, effort=effort)

    @staticmethod
    def _wrench(outputs: Sequence[Output]) -> WrenchStamped:
        message = WrenchStamped()
        six = {'linear': message.wrench.force, 'angular': message.wrench.torque}
        for _, _, estimate, values in outputs:
            _set_axis(six, values, estimate.unknown_input * values['unknown_input_scale'])
        return message

    @staticmethod
    def _accel(outputs: Sequence[Output]) -> AccelStamped:
        message = AccelStamped()
        six = {'linear': message.accel.linear, 'angular': message.accel.angular}
        for _, _, estimate, values in outputs:
            _set_axis(six, values, estimate.unknown_input)
        return message


def _set_axis(six: Mapping[str, Vector3], values: Mapping[str, Any], number: float) -> None:
    vector, axis = values['output_axis'].split('.')
    setattr(six[vector], axis, number)


def check_axes(values: Mapping[str, Any], own: Mapping[str, Mapping[str, Any]]) -> None:
    """
    Raise if two channels would write to the same axis.

    Parameters
    ----------
    values : mapping
        Parameters of the node.
    own : mapping
        Those of each channel, by its name.

    Raises
    ------
    ConfigurationError

    """
    if not {'wrench', 'accel'} & set(values['typed_outputs']):
        return
    taken: dict[str, str] = {}
    for name, mine in own.items():
        axis = mine['output_axis']
        if axis in taken:
            raise ConfigurationError(
                f"parameter 'output_axis': expected another axis for each channel, got {axis!r} "
                f'for {taken[axis]} and for {name}'
            )
        taken[axis] = name
