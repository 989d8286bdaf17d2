# SPDX-License-Identifier: Apache-2.0
"""An estimator's memory on a topic, so that a replay can follow a live run exactly."""

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.snapshots import Flag, pack, Snapshot
from fhaosmo_ros.nodes.middleware.messages import labelled, message_class
from fhaosmo_ros.topics import ARRAY, SNAPSHOT
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

PERIOD, PERIOD_OF_SELF_TUNING = 1.0, 30.0
"""In seconds; a self-tuning estimator remembers thousands of numbers."""
QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A recorder that starts later still gets the latest ones."""


class SnapshotPublisher:
    """
    Publishes once a second, after the first sample, and after each live change and reset.

    Parameters
    ----------
    node : Node
    estimator : OnlineEstimator
    prefix : str
        Prefix of the topic's name.

    """

    def __init__(self, node: Node, estimator: OnlineEstimator, prefix: str) -> None:
        self._node, self._estimator = node, estimator
        self._due, self._first = True, True
        self._labels: list[str] = []
        self._publisher = node.create_publisher(message_class(ARRAY), prefix + SNAPSHOT, QOS)
        period = PERIOD_OF_SELF_TUNING if estimator.observer.self_tuning else PERIOD
        self._timer = node.create_timer(period, self._request)

    def _request(self) -> None:
        self._due = True

    def accepted(self, stamp: int) -> None:
        """Publish if a second has passed; to be called for each sample that was accepted."""
        if self._due:
            # In a queue the observer may be samples ahead of this one.
            begins = self._first and stamp == self._estimator.latest
            self._publish(Flag.STARTED if begins else Flag(0))

    def changed(self) -> None:
        """Publish that parameters or `freeze` have changed after the latest sample."""
        self._publish(Flag.CHANGED)

    def reset(self) -> None:
        """Publish that the estimator was reset after the latest sample."""
        self._publish(Flag.RESET)
        self._due = self._first = True

    def _publish(self, flags: Flag) -> None:
        stamp = self._estimator.latest
        if stamp is not None:
            labels, vector = pack(Snapshot(stamp, flags, self._estimator.state_dict()))
            if labels != self._labels:  # a state before a gap is there only after one
                self._labels, self._message = labels, labelled(labels)
            self._publisher.publish(self._message(vector))
            self._due = self._first = False

    def destroy(self) -> None:
        """Take the topic away."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
