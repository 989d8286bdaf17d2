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
OF_ALL_NODES = ('/diagnostics', '/rosout', '/parameter_events')
OF_NODES = ('/y', '/u', *OF_ALL_NODES)
"""Topics that are recorded with those of some nodes."""
SHARED = (*OF_ALL_NODES, '/tf', '/tf_static')
"""Topics of many publishers: the sequence numbers of their messages say nothing."""


class PrivateNode(Spinner):
    """
    A `node` in a context of its own, without signal handlers; spun while open.

    `ros_arguments` are what launch gives each node: names, remappings, enclave.
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

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> bool:
        """Ask a node to change parameters, if it is known yet; return whether it was asked."""
        client = self._client(node)
        if client.services_are_ready():
            client.set_parameters([Parameter(k, value=v) for k, v in values.items()])
            return True
        return False

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

    Recorded are `topics`, and of `nodes` (full names) those below their names, whatever they
    listen to, and `OF_NODES`; or `everything` that has a publisher. Stamps are the messages'
    source time stamps, but see `OLD`. Nobody else may write to the bag meanwhile.

    `counts` are the messages that have come, by topic; `problems` lines that say why a topic can't
    be recorded, or not as a whole.
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
        self.problems: list[str] = []
        self._bag, self._everything, self._begin = bag, everything, time_ns()
        resolved = self.node.resolve_topic_name  # after remapping; names of nodes, too
        self._nodes = list(map(resolved, nodes))
        self._topics = set(map(resolved, [*topics, *(OF_NODES if nodes else ())]))
        self._seen = set[str]()
        self._numbers = dict[str, SequenceNumbers]()  # of those that are recorded

    def __enter__(self) -> 'TopicRecorder':
        self._discover()
        self.node.create_timer(DISCOVERY_PERIOD, self._discover)
        self.node.create_timer(FLUSH_PERIOD, lambda: self._write(self._bag.flush))
        super().__enter__()
        return self

    @property
    def lost(self) -> dict[str, int]:
        """Messages that did not arrive, by topic, of topics with one publisher."""
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
            if profiles:
                self._seen.add(topic)
                try:
                    self._record(topic, types[0], profiles, measured=topic in inputs)
                except LookupError as error:
                    self.problems.append(f'not recorded: {topic}: {error}')

    def _record(
        self, topic: str, message_type: str, profiles: Sequence[QoSProfile], measured: bool
    ) -> None:
        """Record a topic with the strictest QoS that every publisher offers."""
        kind = message_class(message_type)
        offered = [_plain(p) for p in profiles]
        different = [qos for k, qos in enumerate(offered) if qos not in offered[:k]]
        if self._write(self._bag.add, topic, message_type, different) is False:
            self.problems.append(f'{topic}: the bag will lack the definition of its type')
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
            stamp = self._begin if stamp < earliest else stamp
            self._write(self._bag.write, topic, stamp, data)
            self.counts[topic] += 1

        subscribe_with_info(self.node, kind, topic, receive, qos, raw=True)


def _plain(profile: QoSProfile) -> dict[str, Any]:
    """Return a QoS as bags describe it."""
    found: dict[str, Any] = {'depth': profile.depth, 'avoid_ros_namespace_conventions': False}
    for name in ('history', 'reliability', 'durability', 'liveliness'):
        found[name] = getattr(profile, name).name.lower()
    if not found['history'].startswith('keep'):
        found['history'] = 'unknown'
    for name in ('deadline', 'lifespan', 'liveliness_lease_duration'):
        seconds, nanoseconds = divmod(getattr(profile, name).nanoseconds, 1_000_000_000)
        found[name] = {'sec': seconds, 'nsec': nanoseconds}
    return found
