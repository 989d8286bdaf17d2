# SPDX-License-Identifier: Apache-2.0
"""Nodes that tools make for themselves, to play topics and to record them."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
import shlex
from time import time_ns
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.endpoints import SequenceNumbers, subscribe_with_info
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.nodes.middleware.spin import of_rcl, Spinner
from fhaosmo_ros.topics import OF_ALL_NODES
import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

PLAYED_DEPTH, RECORDED_DEPTH = 1000, 5000
DISCOVERY_PERIOD = 0.2
FLUSH_PERIOD = 0.5
"""Seconds between two flushes of a bag: a kill loses no more than that."""
OLD = 60 * 1_000_000_000
"""
Nanoseconds. A transient-local message that is older than the recording by more than this gets the
stamp of the recording's beginning; else the bag would begin when somebody started the robot.
"""
OF_NODES = ('/y', '/u', *OF_ALL_NODES)
"""Topics that are recorded with those of some nodes."""
SHARED = ('/parameter_events', '/rosout', '/diagnostics', '/tf', '/tf_static')
"""Topics of many publishers: the sequence numbers of their messages say nothing."""


class PrivateNode(Spinner):
    """
    A `node` in a context of its own, without signal handlers; spun while open.

    `ros_arguments` are what launch gives to every node behind ``--ros-args``: names, remappings,
    enclave.
    """

    def __init__(self, name: str, ros_arguments: Sequence[str] = ()) -> None:
        context, given = Context(), ['--ros-args', *ros_arguments]
        no_handlers = SignalHandlerOptions.NO
        try:
            rclpy.init(args=given, context=context, signal_handler_options=no_handlers)
            node = Node(name, context=context)
        except (RuntimeError, ParameterException) as error:
            problem = of_rcl(error)
            raise ConfigurationError(f'ROS arguments {shlex.join(given)}: {problem}') from None
        self._client = cache(partial(AsyncParameterClient, node))  # by the name of its node
        super().__init__(node)

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> None:
        """Ask another node to change parameters; what it answers is not waited for."""
        changes = [Parameter(name, value=value) for name, value in values.items()]
        self._client(node).set_parameters(changes)

    def can_set_parameters(self, node: str) -> bool:
        """
        Return whether another node offers its parameters.

        Asked early, it makes a client early: the first request of a new one can wait 3 s.
        """
        return bool(self._client(node).services_are_ready())

    def publisher(
        self, topic: str, message_type: str, transient_local: bool
    ) -> Callable[[bytes], None]:
        """Return a function that publishes messages in CDR; LookupError for an unknown type."""
        qos = QoSProfile(depth=PLAYED_DEPTH)
        if transient_local:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        publisher = self.node.create_publisher(message_class(message_type), topic, qos)
        return publisher.publish  # type: ignore[no-any-return]


class TopicRecorder(PrivateNode):
    """
    A node that records to a bag while it is open: topics as they appear, with their QoS.

    Stamps are the messages' source time stamps, but see `OLD`.

    Parameters
    ----------
    bag : BagWriter
        Nobody else may write to it meanwhile.
    nodes : sequence of str
        Full names of nodes whose topics to record: those below their names, whatever they listen
        to, and `OF_NODES`.
    topics : collection of str
        Names of other topics.
    everything : bool
        Record every topic that has a publisher.
    ros_arguments : sequence of str
        See `PrivateNode`.

    Attributes
    ----------
    counts : Counter of str
        Messages by topic that have come.
    problems : list of str
        Lines that say why a topic can't be recorded, or not as a whole.

    """

    grace = None  # what is being written is written before the bag is closed

    def __init__(
        self,
        bag: Any,
        nodes: Sequence[str] = (),
        topics: Collection[str] = (),
        everything: bool = False,
        ros_arguments: Sequence[str] = (),
    ) -> None:
        super().__init__('fhaosmo_recorder', ros_arguments)
        self.counts: Counter[str] = Counter()
        self._numbers: dict[str, SequenceNumbers] = {}
        self.problems: list[str] = []
        self._bag, self._everything = bag, everything
        resolved = self.node.resolve_topic_name  # after remapping; names of nodes, too
        self._nodes = [resolved(name) for name in nodes]
        self._topics = {resolved(name) for name in [*topics, *(OF_NODES if nodes else ())]}
        self._begin = time_ns()
        self._seen: set[str] = set()

    def __enter__(self) -> 'TopicRecorder':
        self._discover()
        self.node.create_timer(DISCOVERY_PERIOD, self._discover)
        self.node.create_timer(FLUSH_PERIOD, lambda: self._write(self._bag.flush))
        super().__enter__()
        return self

    @property
    def lost(self) -> dict[str, int]:
        """Messages that did not arrive, by topic; of topics with one publisher only."""
        return {topic: n.lost for topic, n in self._numbers.items() if n.single and n.lost}

    def check(self) -> None:
        """Raise what ended the recording: of the system, such as a full disk, or of a callback."""
        if self.error:
            raise self.error

    def _write(self, write: Callable[..., Any], *arguments: Any) -> Any:
        """Write until that fails: rclpy would print the stack of what a callback raises."""
        if self.error is None:
            try:
                return write(*arguments)
            except OSError as error:
                self.error = error
        return None

    def _discover(self) -> None:
        inputs = set()  # what the nodes listen to
        for full_name in self._nodes:
            space, _, name = full_name.rpartition('/')
            with suppress(NodeNameNonExistentError):  # not there yet
                heard = self.node.get_subscriber_names_and_types_by_node(name, space or '/')
                inputs |= {topic for topic, _ in heard}
        wanted = inputs | self._topics
        below = tuple(f'{name}/' for name in self._nodes)
        for topic, types in self.node.get_topic_names_and_types():
            its_own = self._everything or topic in wanted or topic.startswith(below)
            if topic in self._seen or not its_own:
                continue
            publishers = self.node.get_publishers_info_by_topic(topic)
            profiles = [p.qos_profile for p in publishers if p.node_name != self.node.get_name()]
            if not profiles:
                continue
            self._seen.add(topic)  # also if it can't be recorded
            try:
                kind = message_class(types[0])
            except LookupError as error:
                self.problems.append(f'not recorded: {topic}: {error}')
                continue
            offered = [_plain(p) for p in profiles]
            different = [qos for k, qos in enumerate(offered) if qos not in offered[:k]]
            if self._write(self._bag.add, topic, types[0], different) is False:
                self.problems.append(f'{topic}: the bag will lack the definition of its type')
            self._subscribe(topic, kind, profiles, measured=topic in inputs)

    def _subscribe(
        self, topic: str, kind: Any, profiles: Sequence[QoSProfile], measured: bool
    ) -> None:
        """Record a topic with the strictest QoS that every publisher offers."""
        qos = QoSProfile(depth=RECORDED_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        if all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles):
            qos.reliability = ReliabilityPolicy.RELIABLE
        if latched := all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles):
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        numbers = self._numbers[topic] = SequenceNumbers()
        numbers.single = len(profiles) == 1 and topic not in SHARED
        # Measured samples keep their stamps, even those of a clock that is wrong.
        earliest = self._begin - OLD if latched and not measured else 0

        def receive(data: bytes, info: Mapping[str, int]) -> None:
            numbers.take(info)
            stamp = info['source_timestamp'] or info['received_timestamp']
            stamp = stamp if stamp >= earliest else self._begin
            self._write(self._bag.write, topic, stamp, data)
            self.counts[topic] += 1

        subscribe_with_info(self.node, kind, topic, receive, qos, raw=True)


def _plain(profile: QoSProfile) -> dict[str, Any]:
    """Return a QoS as bags describe it."""
    names = {
        name: getattr(profile, name).name.lower()
        for name in ('history', 'reliability', 'durability', 'liveliness')
    }
    if not names['history'].startswith('keep'):
        names['history'] = 'unknown'
    times = {}
    for name in ('deadline', 'lifespan', 'liveliness_lease_duration'):
        seconds, nanoseconds = divmod(getattr(profile, name).nanoseconds, 1_000_000_000)
        times[name] = {'sec': seconds, 'nsec': nanoseconds}
    return {**names, **times, 'depth': profile.depth, 'avoid_ros_namespace_conventions': False}
