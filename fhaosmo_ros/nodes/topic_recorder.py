# SPDX-License-Identifier: Apache-2.0
"""Subscribes topics as they appear, with the QoS of their publishers, and queues what comes."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
import importlib
from queue import SimpleQueue
from time import time_ns
from typing import Any, NamedTuple, Self

from fhaosmo_ros.nodes.private_node import PrivateNode
from fhaosmo_ros.nodes.subscription import subscribe_with_info
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

DEPTH = 5000
DISCOVERY_PERIOD = 0.2
OLD = 60 * 1_000_000_000
"""
Nanoseconds. A latched message that is older than the recording by more than this gets the stamp
of the recording's beginning, or the bag would begin when somebody started the robot.
"""
SHARED = ('/parameter_events', '/rosout', '/diagnostics', '/tf', '/tf_static')
"""Topics of many publishers: the numbers of their messages tell nothing."""


class NewTopic(NamedTuple):
    """A topic that is recorded from now on, with the QoS of each of its publishers."""

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
    wanted : callable
        Says of a topic's name whether to record it.
    listeners : sequence of str
        Full names of nodes whose inputs to record as well, whatever their names.

    Attributes
    ----------
    queue : SimpleQueue
        `NewTopic`, then the topic's `Sample`; the executor's thread fills it.
    problems : SimpleQueue
        Lines that say why a topic can't be recorded.
    lost : dict of str to int
        Messages by topic that were published but did not arrive; only of topics with one
        publisher, whose messages are numbered.

    """

    def __init__(self, wanted: Callable[[str], bool], listeners: Sequence[str] = ()) -> None:
        self.queue: SimpleQueue[NewTopic | Sample] = SimpleQueue()
        self.problems: SimpleQueue[str] = SimpleQueue()
        self.lost: dict[str, int] = {}
        self._wanted, self._listeners = wanted, listeners
        self._known: set[str] = set()
        self._begin = time_ns()
        super().__init__('fhaosmo_recorder')
        self.node.create_timer(DISCOVERY_PERIOD, self._discover)

    def __enter__(self) -> Self:
        self._discover()
        return super().__enter__()

    def _discover(self) -> None:
        inputs = self._inputs()
        for topic, types in self.node.get_topic_names_and_types():
            if topic in self._known or not (topic in inputs or self._wanted(topic)):
                continue
            publishers = self.node.get_publishers_info_by_topic(topic)
            publishers = [p for p in publishers if p.node_name != self.node.get_name()]
            if not publishers:
                continue
            self._known.add(topic)
            try:
                message_class = _message_class(types[0])
            except (ImportError, AttributeError, ValueError):
                self.problems.put(
                    f'{topic}: expected a message type that is installed here, got {types[0]}'
                )
                continue
            profiles = [p.qos_profile for p in publishers]
            qos = _matching(profiles)
            latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
            # What is measured keeps its stamps, even those of a clock that is wrong.
            limit = self._begin - OLD if latched and topic not in inputs else 0
            numbered = len(publishers) == 1 and topic not in SHARED
            self.queue.put(NewTopic(topic, types[0], [_plain(p) for p in profiles]))
            subscribe_with_info(
                self.node, message_class, topic,
                self._callback(topic, numbered, limit), qos, raw=True,
            )  # fmt: skip

    def _inputs(self) -> set[str]:
        found = set()
        for listener in self._listeners:
            space, _, name = listener.rpartition('/')
            with suppress(NodeNameNonExistentError):  # not there yet
                topics = self.node.get_subscriber_names_and_types_by_node(name, space or '/')
                found |= {topic for topic, _ in topics}
        return found

    def _callback(self, topic: str, numbered: bool, limit: int) -> Any:
        put = self.queue.put
        latest = 0

        def receive(data: bytes, info: Mapping[str, int]) -> None:
            nonlocal latest
            number = info.get('publication_sequence_number') or 0 if numbered else 0
            if latest and number > latest + 1:
                self.lost[topic] = self.lost.get(topic, 0) + number - latest - 1
            elif 0 < number <= latest:  # another publisher: its numbers tell nothing
                self.lost.pop(topic, None)
                number = 2**63
            latest = max(latest, number)
            stamp = info['source_timestamp'] or info['received_timestamp']
            put(Sample(topic, stamp if stamp >= limit else self._begin, data))

        return receive


def _message_class(message_type: str) -> Any:
    package, kind, name = message_type.split('/')
    return getattr(importlib.import_module(f'{package}.{kind}'), name)


def _matching(profiles: list[QoSProfile]) -> QoSProfile:
    """Return the strictest QoS that every publisher offers."""
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    local = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return QoSProfile(
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if local else DurabilityPolicy.VOLATILE,
    )


def _plain(profile: QoSProfile) -> dict[str, Any]:
    """Return a QoS as names and numbers."""
    return {
        'history': profile.history.name,
        'depth': profile.depth,
        'reliability': profile.reliability.name,
        'durability': profile.durability.name,
        'deadline': profile.deadline.nanoseconds,
        'lifespan': profile.lifespan.nanoseconds,
        'liveliness': profile.liveliness.name,
        'liveliness_lease_duration': profile.liveliness_lease_duration.nanoseconds,
    }
