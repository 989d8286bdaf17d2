# SPDX-License-Identifier: Apache-2.0
"""What a channel publishes, and the text with the parameters of its node."""

from time import monotonic

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.estimates import Estimate, TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.snapshots import Flag, pack, Snapshot
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.per_channel import CHANNELS, differing, of_channel
from fhaosmo_ros.inputs import Input, known_inputs, measured_output
from fhaosmo_ros.nodes.middleware.endpoints import create_publisher, has_listeners, LATCHED
from fhaosmo_ros.nodes.middleware.messages import labelled, message_class, time_message
from fhaosmo_ros.topics import (
    ARRAY,
    estimates_of,
    SNAPSHOT,
    STANDARD_DEVIATION,
)
from rclpy.node import Node
from std_msgs.msg import Float64

PERIOD, PERIOD_OF_SELF_TUNING = 1.0, 30.0
"""Seconds between two snapshots; a self-tuning estimator remembers thousands of numbers."""


class Outputs:
    """
    Publishers of the estimates, each with ROS' parameters qos_overrides./TOPIC.publisher.POLICY.

    What nobody listens to is not made: a message costs as much as a step with fixed gains.
    """

    def __init__(self, node: Node, prefix: str, estimator: OnlineEstimator) -> None:
        observer = estimator.observer
        self._estimator = estimator
        self._publishers = {
            name: create_publisher(node, message_class(kind), prefix + name)
            for name, kind in estimates_of(observer.parameters).items()
        }
        states = [f'z{i + 1}' for i in range(observer.order)]
        self._state, self._tuning = labelled(states), labelled(TUNING)
        self._deviation = labelled([*states, 'd'])
        self._innovation = labelled([f'eps{i + 1}' for i in range(observer.levels)])

    def publish(self, estimate: Estimate, stamp: int) -> None:
        """Publish an estimate and, last, the stamp of its sample in nanoseconds."""
        estimator = self._estimator
        messages = {
            'gamma': lambda: Float64(data=estimate.gamma),
            STANDARD_DEVIATION: lambda: self._deviation(estimator.standard_deviation),
            'tuning': lambda: self._tuning(estimator.observer.structure.found),
            'state': lambda: self._state(estimate.z),
            'unknown_input': lambda: Float64(data=estimate.unknown_input),
            'innovation': lambda: self._innovation(estimate.innovation),
            'stamp': lambda: time_message(stamp),
        }
        for name, publisher in self._publishers.items():
            if has_listeners(publisher):
                publisher.publish(messages[name]())


class SnapshotOutput:
    """
    Publisher of an estimator's memory, so that a replay can follow a live run exactly.

    Once a second, after the first sample, and after each live change and reset.
    """

    def __init__(self, node: Node, prefix: str, estimator: OnlineEstimator) -> None:
        self._estimator = estimator
        self._period = PERIOD_OF_SELF_TUNING if estimator.observer.self_tuning else PERIOD
        self._first, self._published = True, 0.0
        self._labels: list[str] = []
        self._publisher = node.create_publisher(message_class(ARRAY), prefix + SNAPSHOT, LATCHED)

    def accepted(self, stamp: int) -> None:
        """Publish if it is time to; to be called for each sample that was accepted."""
        if self._first or monotonic() - self._published >= self._period:
            # Where samples wait in a queue, the observer may be ahead of this one.
            begins = self._first and stamp == self._estimator.latest
            self._publish(Flag.STARTED if begins else Flag(0))

    def changed(self) -> None:
        """Publish that parameters or `freeze` have changed after the latest sample."""
        self._publish(Flag.CHANGED)

    def reset(self) -> None:
        """Publish that the estimator was reset after the latest sample."""
        self._publish(Flag.RESET)
        self._first = True

    def _publish(self, flags: Flag) -> None:
        stamp = self._estimator.latest
        if stamp is not None:
            labels, vector = pack(Snapshot(stamp, flags, self._estimator.state_dict()))
            if labels != self._labels:  # a state before a gap is there only after one
                self._labels, self._message = labels, labelled(labels)
            self._publisher.publish(self._message(vector))
            self._first, self._published = False, monotonic()


def parameter_text(node: Node, values: Parameters) -> str:
    """
    Return the parameters of a node as the text of a file that makes such a node.

    It has the topics of y and u that a remapping has changed: a bag knows of none.
    """
    resolved = node.resolve_topic_name

    def is_remapped(wanted: Input) -> bool:
        return bool(resolved(wanted.topic) != wanted.absolute(node.get_namespace()))

    named = differing(values)
    for channel in values[CHANNELS]:
        prefix = f'{channel}.' if channel else ''
        own = of_channel(values, channel)
        y = measured_output(own, channel)
        if is_remapped(y):
            named[f'{prefix}input_topic'] = resolved(y.topic)
            named[f'{prefix}input_type'] = y.message_type
        u = known_inputs(own, TriangularModel.of(own).used_inputs, channel).values()
        if any(map(is_remapped, u)):
            named[f'{prefix}known_input_topics'] = [resolved(one.topic) for one in u]
            named[f'{prefix}known_input_types'] = [one.message_type for one in u]
    return dumps(named, node.get_fully_qualified_name())
