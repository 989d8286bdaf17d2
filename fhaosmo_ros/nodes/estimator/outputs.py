# SPDX-License-Identifier: Apache-2.0
"""Messages of one channel, and of all together; the text with the parameters of their node."""

from collections.abc import Callable, Iterable, Mapping
from math import nan
from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.core.observer.estimates import Estimate, TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.per_channel import differing
from fhaosmo_ros.nodes.middleware.endpoints import DEPTH, Listeners
from fhaosmo_ros.nodes.middleware.messages import labelled, message_class, time_message
from fhaosmo_ros.topics import STANDARD_DEVIATION, TYPED_ESTIMATES
import numpy as np
from rclpy.node import Node
from std_msgs.msg import Float64

Make = Callable[[Estimate, int], Any]
"""Returns the message of an estimate and of the stamp of its sample in nanoseconds."""


def estimate_messages(estimator: OnlineEstimator) -> dict[str, Make]:
    """Return what makes the message of each topic of an estimator's estimates, by its name."""
    observer, number, time = estimator.observer, Float64(), Time()  # filled again and again
    states = [f'z{i + 1}' for i in range(observer.order)]
    state, deviation, tuning = labelled(states), labelled([*states, 'd']), labelled(TUNING)
    innovation = labelled([f'eps{i + 1}' for i in range(observer.levels)])

    def filled(value: float) -> Float64:
        number.data = value
        return number

    return {
        'gamma': lambda estimate, _: filled(estimate.gamma),
        STANDARD_DEVIATION: lambda *_: deviation(estimator.standard_deviation),
        'tuning': lambda *_: tuning(np.hstack(estimator.tuning)),
        'state': lambda estimate, _: state(estimate.z),
        'unknown_input': lambda estimate, _: filled(estimate.unknown_input),
        'innovation': lambda estimate, _: innovation(estimate.innovation),
        'stamp': lambda _, stamp: time_message(stamp, time),
    }


Output = tuple[int, Estimate, Mapping[str, Any]]
"""Stamp of a sample (ns), the estimate that belongs to it, parameters of its channel."""


class TypedOutputs:
    """Publishers of the messages that ``typed_outputs`` asks for, each for all channels."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._frame: str = values['frame_id']
        self._waiting: dict[str, Output] = {}  # by the name of the channel
        self._listeners = Listeners({
            name: node.create_publisher(message_class(TYPED_ESTIMATES[name]), f'~/{name}', DEPTH)
            for name in dict.fromkeys(values['typed_outputs'])
            if name != 'none'
        })  # fmt: skip

    def add(self, name: str, output: Output) -> None:
        """Let an estimate wait for those of other channels."""
        if name in self._waiting:  # several samples had waited for their known inputs
            self.publish()
        self._waiting[name] = output

    def publish(self) -> None:
        """Publish the estimates that wait, with the latest of their stamps."""
        if not self._waiting:
            return
        for name, publisher in self._listeners.heard().items():
            message = publisher.msg_type()
            _fill(message, name, self._waiting)
            message.header.frame_id = self._frame
            message.header.stamp = time_message(max(stamp for stamp, *_ in self._waiting.values()))
            publisher.publish(message)
        self._waiting.clear()


def _fill(message: Any, name: str, outputs: Mapping[str, Output]) -> None:
    """Put estimates into a JointState, a wrench of efforts, or an accel of unknown inputs."""
    for channel, (_, estimate, values) in outputs.items():
        z, d = estimate.z, float(estimate.unknown_input)
        effort = d * values['unknown_input_scale']
        vector, axis = values['output_axis'].split('.')
        if name == 'joint_states':
            message.name.append(channel)
            message.position.append(z[0])
            message.velocity.append(z[1] if len(z) > 1 else nan)
            message.effort.append(effort)
        elif name == 'wrench':
            force = {'linear': message.wrench.force, 'angular': message.wrench.torque}[vector]
            setattr(force, axis, effort)
        else:
            setattr(getattr(message.accel, vector), axis, d)


def parameter_text(node: Node, values: Parameters, channels: Iterable[Any]) -> str:
    """
    Return the parameters of a node as the text of a file that makes such a node.

    It has the full names of the topics of y and u: a bag knows of no remapping.
    """
    named = differing(values)
    for channel in channels:
        prefix = f'{channel.name}.' if channel.name else ''
        y, u = channel.y, channel.u.values()
        named[f'{prefix}input_topic'] = y.source.topic
        named[f'{prefix}input_type'] = y.wanted.message_type
        if u:
            named[f'{prefix}known_input_topics'] = [one.source.topic for one in u]
            named[f'{prefix}known_input_types'] = [one.wanted.message_type for one in u]
    return dumps(named, node.get_fully_qualified_name())
