# SPDX-License-Identifier: Apache-2.0
"""Records topics as they appear, with the QoS of their publishers."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from queue import SimpleQueue
from time import time_ns
from typing import Any, NamedTuple

from fhaosmo_ros.nodes.middleware.endpoints import subscribe_with_info
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.nodes.recording.private_node import PrivateNode
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

DEPTH = 5000
DISCOVERY_PERIOD = 0.2
OLD = 60 * 1_000_000_000
"""
Nanoseconds. A transient-local message that is older than the recording by more than this gets the
stamp of the recording's beginning; else the bag would begin when somebody started the robot.
"""
DURABILITIES = (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL)
SHARED = ('/parameter_events', '/rosout', '/diagnostics', '/tf', '/tf_static')
"""Topics of many publishers: the sequence numbers of their messages say nothing."""


class NewTopic(NamedTuple):
    """A topic that has appeared and is recorded from now on, with its publishers' QoS."""

    topic: str
    message_type: str
    offered: list[dict[str, Any]]


class Sample(NamedTuple):
    """A message in CDR with its source time stamp in nanoseconds, but see `OLD`."""

    topic: str
    stamp: int
    data: bytes


class TopicRecorder(PrivateNode):
    """
    A node that records while it is open.

    Parameters
    ----------
    sink : callable
        Called with `NewTopic`, then with the topic's `Sample`s, from the executor's thread.
    wanted : callable
        Says of the name of a topic that has a publisher whether to record it. Called while it is
        open.
    listeners : sequence of str
        Names of nodes whose inputs to record as well, whatever their names.
    ros_arguments : sequence of str
        See `PrivateNode`.

    Attributes
    ----------
    counts, lost : Counter of str
        Messages by topic that have come, and those that did not arrive; the latter only of topics
        with one publisher, whose messages are numbered.
    problems : SimpleQueue
        Lines that say why a topic can't be recorded.

    """

    def __init__(
        self,
        sink: Callable[[NewTopic | Sample], None],
        wanted: Callable[[str], bool],
        listeners: Sequence[str] = (),
        ros_arguments: Sequence[str] = (),
    ) -> None:
        super().__init__('fhaosmo_recorder', ros_arguments)
        self.counts: Counter[str] = Counter()
        self.problems: SimpleQueue[str] = SimpleQueue()
        self.lost: Counter[str] = Counter()
        self._sink, self._wanted = sink, wanted
        self._begin = time_ns()
        self._listeners = [self.resolved(name) for name in listeners]
        self._seen: set[str] = set()

    def __enter__(self) -> 'TopicRecorder':
        self._discover()
        self.node.create_timer(DISCOVERY_PERIOD, self._discover)
        super().__enter__()
        return self

    def _discover(self) -> None:
        inputs = self._inputs()
        for topic, types in self.node.get_topic_names_and_types():
            if topic in self._seen or not (topic in inputs or self._wanted(topic)):
                continue
            publishers = self.node.get_publishers_info_by_topic(topic)
            profiles = [p.qos_profile for p in publishers if p.node_name != self.node.get_name()]
            if not profiles:
                continue
            self._seen.add(topic)  # also if it can't be recorded
            try:
                kind = message_class(types[0])
            except LookupError as error:
                self.problems.put(f'{topic}: {error}')
                continue
            qos = _matching(profiles)
            # Measured samples keep their stamps, even those of a clock that is wrong.
            bounded = qos.durability == DURABILITIES[True] and topic not in inputs
            self._sink(NewTopic(topic, types[0], [_plain(p) for p in profiles]))
            self._subscribe(topic, kind, qos, len(profiles) == 1, bounded)

    def _subscribe(
        self, topic: str, kind: Any, qos: QoSProfile, numbered: bool, bounded: bool
    ) -> None:
        """Record a topic; numbered: of one publisher; bounded: no stamp is older than `OLD`."""
        latest = 0
        numbered = numbered and topic not in SHARED
        earliest = self._begin - OLD if bounded else 0

        def receive(data: bytes, info: Mapping[str, int]) -> None:
            nonlocal latest
            number = info.get('publication_sequence_number') or 0 if numbered else 0
            if latest and number > latest + 1:
                self.lost[topic] += number - latest - 1
            elif 0 < number <= latest:  # another publisher: its numbers say nothing
                self.lost.pop(topic, None)
                number = 2**63
            latest = max(latest, number)
            stamp = info['source_timestamp'] or info['received_timestamp']
            self._sink(Sample(topic, stamp if stamp >= earliest else self._begin, data))
            self.counts[topic] += 1

        subscribe_with_info(self.node, kind, topic, receive, qos, raw=True)

    def _inputs(self) -> set[str]:
        found = set()
        for listener in self._listeners:
            space, _, name = listener.rpartition('/')
            with suppress(NodeNameNonExistentError):  # not there yet
                topics = self.node.get_subscriber_names_and_types_by_node(name, space or '/')
                found |= {topic for topic, _ in topics}
        return found


def _matching(profiles: list[QoSProfile]) -> QoSProfile:
    """Return the strictest QoS that every publisher offers."""
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    local = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    best_effort = ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else best_effort,
        durability=DURABILITIES[local],
    )


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
