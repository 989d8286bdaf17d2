# SPDX-License-Identifier: Apache-2.0
"""Estimates as the stamped messages that robots use: JointState, WrenchStamped, AccelStamped."""

from collections.abc import Callable, Mapping, Sequence
import struct
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.estimates import Estimate
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.messages import message_class, TIME
from fhaosmo_ros.nodes.middleware.publishers import listeners_of
from fhaosmo_ros.topics import TYPED_ESTIMATES
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

AXES = ('linear.x', 'linear.y', 'linear.z', 'angular.x', 'angular.y', 'angular.z')
SIX = struct.Struct('=6d')
STAMPED = slice(4, 12)
"""Where the header's stamp stands in a serialised message that begins with a header."""
DEPTH = 10


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
        encoders: dict[str, Callable[[Sequence[Output]], bytes]] = {
            'joint_states': self._joint_states,
            'wrench': self._six('wrench', scaled=True),
            'accel': self._six('accel', scaled=False),
        }
        self._publishers: list[Any] = []
        self._publish = []
        self._joints: dict[tuple[str, ...], tuple[bytes, bytes, bytes]] = {}
        for name in dict.fromkeys(values['typed_outputs']):
            if name != 'none':
                kind = message_class(TYPED_ESTIMATES[name])
                publisher = node.create_publisher(kind, f'~/{name}', QoSProfile(depth=DEPTH))
                self._publishers.append(publisher)
                self._publish.append((listeners_of(publisher), publisher.publish, encoders[name]))

    def publish(self, outputs: Sequence[Output]) -> None:
        """Publish the latest estimates of some channels, with the latest of their stamps."""
        for listeners, publish, encode in self._publish:
            if listeners():
                publish(encode(outputs))

    def destroy(self) -> None:
        """Take the publishers away."""
        self._publish = []
        while self._publishers:
            self._node.destroy_publisher(self._publishers.pop())

    def _joint_states(self, outputs: Sequence[Output]) -> bytes:
        names = tuple(output.name for output in outputs)
        if names not in self._joints:
            self._joints[names] = self._joint_frame(names)
        head, names_text, between = self._joints[names]
        count = len(names)
        pack = struct.Struct(f'={count}d').pack
        nan = float('nan')
        numbers = [
            (e.z[0], e.z[1] if len(e.z) > 1 else nan, e.unknown_input * v['unknown_input_scale'])
            for _, _, e, v in outputs
        ]
        position, velocity, effort = (pack(*column) for column in zip(*numbers, strict=True))
        stamp = TIME.pack(*divmod(max(o.stamp for o in outputs), 1_000_000_000))
        return b''.join([head, stamp, names_text, position, between, velocity, between, effort])

    def _joint_frame(self, names: tuple[str, ...]) -> tuple[bytes, bytes, bytes]:
        """Return what stands before the stamp, before the numbers, and between their lists."""
        zeros = [0.0] * len(names)
        message = JointState(name=names, position=zeros, velocity=zeros, effort=zeros)
        message.header.frame_id = self._frame
        text = serialize_message(message)
        size = 8 * len(names)
        first = len(text) - 3 * size - 16
        between = text[first + size : first + size + 8]  # a length, and padding
        return text[:4], text[STAMPED.stop : first], between

    def _six(self, name: str, scaled: bool) -> Callable[[Sequence[Output]], bytes]:
        message = message_class(TYPED_ESTIMATES[name])()
        message.header.frame_id = self._frame
        text = serialize_message(message)
        head, rest = text[: STAMPED.start], text[STAMPED.stop : -SIX.size]

        def encode(outputs: Sequence[Output]) -> bytes:
            six = [0.0] * 6
            for _, _, estimate, values in outputs:
                scale = values['unknown_input_scale'] if scaled else 1.0
                six[AXES.index(values['output_axis'])] = estimate.unknown_input * scale
            stamp = TIME.pack(*divmod(max(o.stamp for o in outputs), 1_000_000_000))
            return head + stamp + rest + SIX.pack(*six)

        return encode


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
