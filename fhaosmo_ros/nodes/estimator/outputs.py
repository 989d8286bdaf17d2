# SPDX-License-Identifier: Apache-2.0
"""The topics on which a channel publishes its estimates."""

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fhaosmo_ros.core.observer.estimates import Estimate, TUNING
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import described, Event
from fhaosmo_ros.nodes.middleware.messages import labelled, message_class, time_message
from fhaosmo_ros.nodes.middleware.publishers import create_publisher, listeners_of
from fhaosmo_ros.topics import DIAGNOSTICS, estimates_of, EVENT, STANDARD_DEVIATION
from rclpy.node import Node
from std_msgs.msg import Float64

EVENTS_KEPT = 10


class Outputs:
    """
    Publishers of the estimates, each with ROS' parameters qos_overrides./TOPIC.publisher.POLICY.

    What nobody listens to is not made: a message costs as much as a step with fixed gains.

    Parameters
    ----------
    node : Node
    prefix : str
        Prefix of the topics' names.
    observer : Observer

    """

    def __init__(self, node: Node, prefix: str, observer: Observer) -> None:
        self._node = node
        kinds = estimates_of(observer.parameters)
        self._publishers = [
            create_publisher(node, message_class(kind), prefix + name)
            for name, kind in kinds.items()
        ]
        listeners = [listeners_of(publisher) for publisher in self._publishers]
        self._topics = list(zip(kinds, self._publishers, listeners, strict=True))
        states = [f'z{i + 1}' for i in range(observer.order)]
        self._state, self._tuning = labelled(states), labelled(TUNING)
        self._deviation = labelled([*states, 'd'])
        self._innovation = labelled([f'eps{i + 1}' for i in range(observer.levels)])

    def publish(self, estimator: OnlineEstimator, estimate: Estimate, stamp: int) -> None:
        """Publish an estimate and, last, the stamp of its sample in nanoseconds."""
        messages = {
            'gamma': lambda: Float64(data=estimate.gamma),
            STANDARD_DEVIATION: lambda: self._deviation(estimator.standard_deviation),
            'tuning': lambda: self._tuning(estimator.observer.structure.found),
            'state': lambda: self._state(estimate.z),
            'unknown_input': lambda: Float64(data=estimate.unknown_input),
            'innovation': lambda: self._innovation(estimate.innovation),
            'stamp': lambda: time_message(stamp),
        }
        for name, publisher, listeners in self._topics:
            if listeners():
                publisher.publish(messages[name]())

    def destroy(self) -> None:
        """Take the publishers away."""
        while self._publishers:
            self._node.destroy_publisher(self._publishers.pop())


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
