# SPDX-License-Identifier: Apache-2.0
"""The topics on which a channel publishes its estimates."""

from collections.abc import Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fhaosmo_ros.core.observer.estimates import Estimate, TUNING
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import described, Event
from fhaosmo_ros.nodes.middleware.messages import labelled, message_class, time_message
from fhaosmo_ros.nodes.middleware.publishers import create_publisher, listeners_of
from fhaosmo_ros.topics import DIAGNOSTICS, ESTIMATES, EVENT, SELF_TUNED
import numpy as np
from rclpy.node import Node
from std_msgs.msg import Float64

EVENTS_KEPT = 10


class Publishers:
    """
    Publishers of some topics, each with ROS' parameters qos_overrides./TOPIC.publisher.POLICY.

    What nobody listens to is not made: a message costs as much as a step with fixed gains.

    Parameters
    ----------
    node : Node
    prefix : str
        Prefix of the topics' names.
    kinds : mapping of str to str
        Their message types.

    """

    def __init__(self, node: Node, prefix: str, kinds: Mapping[str, str]) -> None:
        self._node = node
        self._publishers = [
            create_publisher(node, message_class(kind), prefix + name)
            for name, kind in kinds.items()
        ]
        self._listeners = [listeners_of(publisher) for publisher in self._publishers]

    def destroy(self) -> None:
        """Take the publishers away."""
        while self._publishers:
            self._node.destroy_publisher(self._publishers.pop())


class Outputs(Publishers):
    """
    Publishers of the estimates.

    Parameters
    ----------
    node : Node
    prefix : str
        Prefix of the topics' names.
    order, levels : int
        Numbers of states and of innovations.

    """

    def __init__(self, node: Node, prefix: str, order: int, levels: int) -> None:
        super().__init__(node, prefix, ESTIMATES)
        self._state = labelled([f'z{i + 1}' for i in range(order)])
        self._innovation = labelled([f'eps{i + 1}' for i in range(levels)])

    def publish(self, estimate: Estimate, stamp: int) -> None:
        """Publish an estimate and, last, the stamp of its sample in nanoseconds."""
        messages = {
            'state': lambda: self._state(estimate.z),
            'unknown_input': lambda: Float64(data=estimate.unknown_input),
            'gamma': lambda: Float64(data=estimate.gamma),
            'innovation': lambda: self._innovation(estimate.innovation),
            'stamp': lambda: time_message(stamp),
        }
        for publisher, listeners, name in zip(
            self._publishers, self._listeners, ESTIMATES, strict=True
        ):
            if listeners():
                publisher.publish(messages[name]())


class TuningOutputs(Publishers):
    """
    Publishers of what a self-tuning observer knows beside its estimates.

    Parameters
    ----------
    node : Node
    prefix : str
        Prefix of the topics' names.
    order : int
        Number of states.

    """

    def __init__(self, node: Node, prefix: str, order: int) -> None:
        super().__init__(node, prefix, SELF_TUNED)
        self._deviation = labelled([*(f'z{i + 1}' for i in range(order)), 'd'])
        self._tuning = labelled(TUNING)

    def publish(self, estimator: OnlineEstimator) -> None:
        """Publish the standard deviations of the latest estimate, and the tuning at its sample."""
        (deviation, tuning), (of_deviation, of_tuning) = self._publishers, self._listeners
        if of_deviation():
            deviation.publish(self._deviation(estimator.standard_deviation))
        if of_tuning():
            noise, correlation, bandwidth, shares = estimator.tuning
            tuning.publish(self._tuning(np.array([noise, correlation, bandwidth, *shares])))


class EventOutput:
    """
    Publisher of events: WARN where one begins, OK where it ends.

    Parameters
    ----------
    node : Node
    prefix : str
        Prefix of the topic's name.
    channel : str
        Name of the channel, '' without names.

    """

    def __init__(self, node: Node, prefix: str, channel: str) -> None:
        self._node = node
        self._name = f'{node.get_fully_qualified_name().lstrip("/")}: {channel} event'
        self._name = self._name.replace(':  ', ': ')
        kind = message_class(DIAGNOSTICS)
        self._publisher = create_publisher(node, kind, prefix + EVENT, EVENTS_KEPT, latched=True)

    def publish(self, event: Event, unit: str, hardware_id: str) -> str:
        """Publish the begin or the end of an event; return it in words."""
        text, values = described(event, unit)
        level = DiagnosticStatus.WARN if event.begins else DiagnosticStatus.OK
        self._send(time_message(event.stamp), DiagnosticStatus(
            level=level, name=self._name, message=text, hardware_id=hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        ))  # fmt: skip
        return text

    def say(self, text: str, hardware_id: str) -> None:
        """Publish that there is no event, and why."""
        status = DiagnosticStatus(name=self._name, message=text, hardware_id=hardware_id)
        self._send(self._node.get_clock().now().to_msg(), status)

    def _send(self, stamp: Time, status: DiagnosticStatus) -> None:
        message = DiagnosticArray(status=[status])
        message.header.stamp = stamp
        self._publisher.publish(message)

    def destroy(self) -> None:
        """Take the publisher away."""
        self._node.destroy_publisher(self._publisher)
