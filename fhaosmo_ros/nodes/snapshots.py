# SPDX-License-Identifier: Apache-2.0
"""An estimator's state on ~/snapshot, so that a replay can follow a live run exactly."""

from time import perf_counter

from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.snapshot import Flag, labels, pack, Snapshot
from fhaosmo_ros.nodes.messages import array_encoder
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64MultiArray

PERIOD = 1.0
LATE = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A recorder that comes late still gets the latest ones."""


class Snapshots:
    """
    Publishes after a start, after a live change and once a second, each at the next sample.

    At a sample that was accepted next to nothing is left over from rejected ones, so the
    observer's state, the timing and the freeze are all there is to know.

    Parameters
    ----------
    node : Node
    prefix : str
        Stands before the topic's name.
    estimator : OnlineEstimator

    Attributes
    ----------
    due : bool
        True if `publish` has to be called at the next sample that is accepted.

    """

    def __init__(self, node: Node, prefix: str, estimator: OnlineEstimator) -> None:
        self._node, self._estimator = node, estimator
        self.due = False
        self._flags = Flag(0)
        self._latest = perf_counter()
        self._encode = array_encoder(labels(estimator.observer.levels))
        self._publisher = node.create_publisher(Float64MultiArray, f'{prefix}snapshot', LATE)

    def tick(self) -> None:
        """Ask for one if the latest is old; to be called now and then."""
        self.due = self.due or perf_counter() - self._latest >= PERIOD

    def started(self) -> None:
        """Say that the observer starts afresh with the next sample."""
        self.due = True
        self._flags |= Flag.STARTED

    def changed(self) -> None:
        """Say that the next sample is the first that is taken with other parameters."""
        self.due = True
        self._flags |= Flag.CHANGED

    def publish(self) -> None:
        """Publish the state after the sample that was just accepted."""
        estimator = self._estimator
        flags = self._flags | (Flag.FROZEN if estimator.frozen else Flag(0))
        state, timing = estimator.observer.state, estimator.timing
        snapshot = Snapshot(estimator.stamp or 0, flags, timing, state)
        self._publisher.publish(self._encode(pack(snapshot)))
        self.due, self._flags, self._latest = False, Flag(0), perf_counter()

    def destroy(self) -> None:
        """Take the topic away."""
        self._node.destroy_publisher(self._publisher)
