# SPDX-License-Identifier: Apache-2.0
"""The estimator's state on ~/snapshot, so that a replay can follow a live run exactly."""

from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.snapshot import Flag, labels, pack, Snapshot
from fhaosmo_ros.nodes.messages import fill, labelled
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64MultiArray

PERIOD = 1.0
LATE = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A recorder that comes late still gets the latest ones."""


class SnapshotPublisher:
    """
    Publishes after a start, after a live change and once a second, each at the next sample.

    At a sample that was accepted nothing is left over from rejected ones, so the observer's state
    is all there is to know.
    """

    def __init__(self, node: Node, estimator: OnlineEstimator) -> None:
        self._estimator = estimator
        self._starts = estimator.counters.starts
        self._due = False
        self._flags = Flag(0)
        self._message = labelled(labels(estimator.observer.levels))
        self._publish = node.create_publisher(Float64MultiArray, '~/snapshot', LATE).publish
        node.create_timer(PERIOD, self._request)

    def _request(self) -> None:
        self._due = True

    def changed(self) -> None:
        """Say that parameters changed: the next sample is the first that is taken with them."""
        self._due = True
        self._flags |= Flag.CHANGED

    def accepted(self) -> None:
        """Publish if it is time to; to be called after each sample that was accepted."""
        starts = self._estimator.counters.starts
        if starts != self._starts:
            self._starts = starts
            self._flags |= Flag.STARTED
        elif not self._due:
            return
        state = self._estimator.observer.state
        snapshot = Snapshot(self._estimator.stamp or 0, self._flags, state)
        self._publish(fill(self._message, pack(snapshot)))
        self._due, self._flags = False, Flag(0)
