# SPDX-License-Identifier: Apache-2.0
"""What channels publish, alone and together, and the text with the parameters of their node."""

from collections.abc import Callable, Iterable, Mapping
from math import nan
from time import perf_counter
from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.core.observer.estimates import Estimate, TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.snapshots import Flag, pack
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.per_channel import differing
from fhaosmo_ros.nodes.estimator.sources import Listener
from fhaosmo_ros.nodes.middleware.endpoints import create_publisher, DEPTH, LATCHED, Listeners
from fhaosmo_ros.nodes.middleware.messages import labelled, message_class, time_message
from fhaosmo_ros.topics import ARRAY, estimates_of, SNAPSHOT, STANDARD_DEVIATION, TYPED_ESTIMATES
import numpy as np
from rclpy.node import Node
from std_msgs.msg import Float64

PERIOD, PERIOD_OF_SELF_TUNING = 1.0, 30.0
"""Seconds between two snapshots; a self-tuning estimator remembers thousands of numbers."""


class Outputs:
    """
    Publishers of one channel's estimates and of its snapshots, by which a replay follows it.

    Those of the estimates have ROS' parameters qos_overrides./TOPIC.publisher.POLICY. What nobody
    listens to is not made: a message costs more than a step with fixed gains.
    """

    def __init__(self, node: Node, prefix: str, estimator: OnlineEstimator) -> None:
        observer = estimator.observer
        self._estimator = estimator
        states = [f'z{i + 1}' for i in range(observer.order)]
        state, deviation, tuning = labelled(states), labelled([*states, 'd']), labelled(TUNING)
        innovation = labelled([f'eps{i + 1}' for i in range(observer.levels)])
        self._make: dict[str, Callable[[Estimate, int], Any]] = {
            'gamma': lambda estimate, _: self._number(estimate.gamma),
            STANDARD_DEVIATION: lambda *_: deviation(estimator.standard_deviation),
            'tuning': lambda *_: tuning(np.hstack(estimator.tuning)),
            'state': lambda estimate, _: state(estimate.z),
            'unknown_input': lambda estimate, _: self._number(estimate.unknown_input),
            'innovation': lambda estimate, _: innovation(estimate.innovation),
            'stamp': lambda _, stamp: time_message(stamp, self._time),
        }
        self._listeners = Listeners({
            name: create_publisher(node, message_class(kind), prefix + name)
            for name, kind in estimates_of(observer.parameters).items()
        })  # fmt: skip
        self._float, self._time = Float64(), Time()  # copied by `publish`, and filled again
        self._period = PERIOD_OF_SELF_TUNING if observer.self_tuning else PERIOD
        self.due, self._labels = 0.0, ['']
        self._snapshots = node.create_publisher(message_class(ARRAY), prefix + SNAPSHOT, LATCHED)

    def _number(self, value: float) -> Float64:
        self._float.data = value
        return self._float

    def publish(self, estimate: Estimate, stamp: int) -> None:
        """Publish an estimate and, last, the stamp of its sample in nanoseconds."""
        for name, publisher in self._listeners.heard().items():
            publisher.publish(self._make[name](estimate, stamp))

    def snapshot(self, flags: Flag) -> None:
        """
        Publish what the estimator remembers, and what has happened at the latest sample.

        The next one is `due` (by perf_counter) a period later, after a reset with the next sample.
        """
        if self._estimator.latest is not None:
            labels, vector = pack(flags, self._estimator.state_dict())
            if labels != self._labels:  # a state before a gap is there only after one
                self._labels, self._message = labels, labelled(labels)
            self._snapshots.publish(self._message(vector))
            self.due = 0.0 if flags == Flag.RESET else perf_counter() + self._period


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

    It has the topics of y and u that a remapping has changed: a bag knows of none.
    """

    def is_remapped(listener: Listener) -> bool:
        return listener.source.topic != listener.wanted.absolute(node.get_namespace())

    named = differing(values)
    for channel in channels:
        prefix = f'{channel.name}.' if channel.name else ''
        y, u = channel.y, channel.u.values()
        if is_remapped(y):
            named[f'{prefix}input_topic'] = y.source.topic
            named[f'{prefix}input_type'] = y.wanted.message_type
        if any(map(is_remapped, u)):
            named[f'{prefix}known_input_topics'] = [one.source.topic for one in u]
            named[f'{prefix}known_input_types'] = [one.wanted.message_type for one in u]
    return dumps(named, node.get_fully_qualified_name())
