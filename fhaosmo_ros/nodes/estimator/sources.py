# SPDX-License-Identifier: Apache-2.0
"""
Subscriptions that channels share: one for each topic, and one look at each of its messages.

The type of a topic is given, or found from the graph: then the subscription begins once somebody
publishes a type that has a wanted field.
"""

from collections.abc import Callable, Iterable, Mapping
from copy import copy
import math
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.inputs import Input
from fhaosmo_ros.messages.fields import Field, find_field, MissingElementError, Unwrapper
from fhaosmo_ros.nodes.middleware.endpoints import (
    full_name,
    OVERRIDABLE,
    SENSOR_QOS,
    subscribe_with_info,
)
from fhaosmo_ros.nodes.middleware.messages import definitions, message_class
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import qos_check_compatible, QoSCompatibility
from rclpy.serialization import deserialize_message

DISCOVERY_PERIOD = 0.2
MOST_WHYS = 3
"""Different reasons that are told, of a publisher that always has another one."""
STAMPS = {'source': 'source_timestamp', 'reception': 'received_timestamp'}
UNKNOWN = '_NODE_NAME_UNKNOWN_'
"""The name of a node that has been discovered later than its publisher, or is none of ROS."""
Gid = tuple[int, ...]
Take = Callable[[int, float, int], None]
"""Gets the stamp of a sample, its value, and when it was published; times in nanoseconds."""


class Listener:
    """
    Somebody who takes one number out of each message of a source.

    `is_sample`: of y, not of a known input, which a message gives first. `field`, the `element` of
    a list that is meant by name, and `stamps` (header, source or reception) are not known before
    the topic's type; `error` says why its type has no such field. `lacking` messages were without
    it; `why`: the latest one of them.
    """

    def __init__(self, wanted: Input, take: Take, source: 'Source', is_sample: bool) -> None:
        self._wanted, self._take = wanted, take
        self.source, self.is_sample = source, is_sample
        self.field: Field | None = None
        self.stamps = self.error = self.element = ''
        self.lacking = 0
        self.why: MissingElementError | None = None
        self._unwrap: Unwrapper | None = None

    def find(self, types: Mapping[str, Any], message_type: str) -> None:
        """Find its field in a message type, or keep the reason as `error`."""
        self.error, self.field = '', None
        try:
            self.field = find_wanted(types, self._wanted._replace(message_type=message_type))
        except ConfigurationError as error:
            self.error = str(error)
            return
        self.stamps, self.element = self._wanted.stamp, self.field.key
        if self.stamps == 'auto':
            self.stamps = 'header' if self.field.header else 'source'
        self._unwrap = Unwrapper() if self.field.wraps else None

    def hear(self, message: Any, header: int, info: Mapping[str, Any]) -> bool:
        """Pass the number in a message on, NaN if there is none; False if it lacks the number."""
        value = math.nan
        if message is not None and self.field is not None:
            try:
                value = self.field.value(message)
            except MissingElementError as error:
                self.lacking += 1
                self.why = error.with_traceback(None)  # which holds the message
                return False
        if self._unwrap:
            value = self._unwrap(value)
        stamp = header if self.stamps == 'header' else info[STAMPS[self.stamps]]
        self._take(stamp, value, info['source_timestamp'])
        return True


class Source:
    """
    A topic and all that its messages are read for.

    `message_type` is '' while it is not known. Of the publishers that `look` has seen, by their
    gid, `heard` are the names of nodes that can be heard; of the others `unheard` has a sentence
    that names the node and says what to do about it. `lost` and `damaged` count messages that did
    not arrive or are shorter than their type. `on_names` is called with the names in each message.
    """

    def __init__(self, node: Node, sources: 'Sources', topic: str) -> None:
        self._node, self._sources, self.topic = node, sources, topic
        self._logger = node.get_logger()
        self.message_type = ''
        self.heard: dict[Gid, str] = {}
        self.unheard: dict[Gid, str] = {}
        self.lost = self.damaged = 0
        self.on_names: Callable[[list[str]], None] | None = None
        self._sequence, self._mixed = 0, False
        self.listeners: list[Listener] = []
        self._served: list[Listener] = []  # those with a field
        self._whys: set[str] = set()
        self._subscribed = False
        self._nameless: set[Gid] = set()
        self._told = ''
        self._timer: Any = None

    def add(self, wanted: Input, take: Take, first: bool = False) -> Listener:
        """Add a listener; a `first` one hears a message before those that are not."""
        listener = Listener(wanted, take, self, is_sample=not first)
        self.listeners.insert(0 if first else len(self.listeners), listener)
        return listener

    def open(self) -> None:
        """Subscribe, now or once the type of the topic is known."""
        if self.message_type:
            self._take_type(self.message_type)
        elif self._timer is None:
            self._timer = self._node.create_timer(
                DISCOVERY_PERIOD, self._discover, clock=Clock(clock_type=ClockType.STEADY_TIME)
            )
            self._discover()

    def look(self) -> None:
        """
        Look at the topic's publishers, and log what has changed.

        The middleware has an event for incompatible QoS, but it does not name the publisher, and
        there is none for another message type. The ROS graph has both.
        """
        if not self._subscribed:
            return
        before, told = self.heard, self.unheard
        self.heard, self.unheard = {}, {}
        for endpoint in self._node.get_publishers_info_by_topic(self.topic):
            gid = tuple(endpoint.endpoint_gid)
            if endpoint.node_name == UNKNOWN and gid not in self._nameless:
                self._nameless.add(gid)  # its node is usually known at the next look
                continue
            name = f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'
            reason = self._mismatch(endpoint)
            if not reason:
                self.heard[gid] = name
                continue
            self.unheard[gid] = f'{name} publishes {self.topic} unheard: {reason}'
            if told.get(gid) != self.unheard[gid]:
                self._logger.error(self.unheard[gid])
        self._mixed = len(self.heard) > 1
        if self._mixed and self.heard.keys() != before.keys():
            names = ' and '.join(sorted(self.heard.values()))
            self._logger.warning(
                f'{len(self.heard)} publishers of {self.topic}, their samples mix: {names}'
            )

    def _mismatch(self, endpoint: Any) -> str:
        """Return why a publisher can't be heard, '' if it can."""
        if endpoint.topic_type != self.message_type:
            return f'its type is {endpoint.topic_type}, expected {self.message_type}'
        verdict, reason = qos_check_compatible(endpoint.qos_profile, self._qos)
        if verdict != QoSCompatibility.ERROR:
            return ''
        clashes = [part.removeprefix('ERROR: ') for part in reason.split(';') if 'ERROR' in part]
        hint = f'change qos_overrides.{self.topic}.subscription, or its own QoS'
        return f'{", ".join(clashes).lower()}; {hint}'

    def _discover(self) -> None:
        """Take the type of the topic's publishers; say once why if that is not possible."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        if not found:
            return
        try:
            self._take_type(min(endpoint.topic_type for endpoint in found))
            problems = [listener.error for listener in self.listeners if listener.error]
        except (LookupError, RuntimeError) as error:  # not installed here; rcl's
            problems = [f'{self.topic}: {error}']
            for listener in self.listeners:
                listener.error = problems[0]
        if self._subscribed:
            self._node.destroy_timer(self._timer)
            self._sources.on_type()
        text = '; '.join(dict.fromkeys(problems))
        if text and text != self._told:
            self._logger.error(text)
        self._told = text

    def _take_type(self, message_type: str) -> None:
        """Find the fields in a message type, and subscribe if there is one."""
        kind, types = message_class(message_type), definitions(message_type)
        for listener in self.listeners:
            listener.find(types, message_type)
        self._served = [listener for listener in self.listeners if listener.field]
        if not self._subscribed and (self._served or self.on_names):
            self._class, self.message_type, self._subscribed = kind, message_type, True
            subscription = subscribe_with_info(
                self._node, kind, self.topic, self._on_message, copy(SENSOR_QOS), raw=True,
                qos_overriding_options=OVERRIDABLE,
            )  # fmt: skip
            self._qos = subscription.qos_profile

    def _on_message(self, data: bytes, info: Mapping[str, Any]) -> None:
        sequence = info['publication_sequence_number'] or 0  # 0: the middleware has none
        if 0 < sequence <= self._sequence:  # another publisher's
            self._mixed = True  # until `look` has seen how many there are
        elif sequence and self._sequence and not self._mixed:
            self.lost += sequence - self._sequence - 1
        self._sequence = sequence
        message, header = None, 0
        try:
            message = deserialize_message(data, self._class)
        except RuntimeError:  # in a subscription that is not raw it would end the node
            self.damaged += 1
        else:
            names = getattr(message, 'name', None) if self.on_names else None
            if names and isinstance(names, list):
                self.on_names(names)
            if self._served and self._served[0].field.header:  # type: ignore[union-attr]
                header = self._served[0].field.stamp(message)  # type: ignore[union-attr]
        lacking = [li for li in self._served if not li.hear(message, header, info)]
        why = str(lacking[0].why) if lacking and len(self._whys) < MOST_WHYS else ''
        if why and why not in self._whys:  # two publishers may alternate
            self._whys.add(why)
            more = f' (and {len(lacking) - 1} more like it)' if lacking[1:] else ''
            self._logger.warning(f'a message on {self.topic} is left out: {why}{more}')
        self._sources.after_message()


class Sources:
    """
    The sources of a node, one for each topic.

    `on_type` is called when the type of a topic has become known, `after_message` after each
    message.
    """

    def __init__(self, node: Node, on_type: Callable[[], None]) -> None:
        self._node, self.on_type = node, on_type
        self._by_topic: dict[str, Source] = {}
        self.after_message: Callable[[], None] = lambda: None

    def of(self, wanted: Input) -> Source:
        """
        Return the source that an input is read from; new ones are not open yet.

        Raises ConfigurationError for a second type of its messages.
        """
        topic, kind = self._node.resolve_topic_name(wanted.topic), wanted.message_type
        source = self._by_topic.setdefault(topic, Source(self._node, self, topic))
        if kind and source.message_type not in ('', kind):
            raise ConfigurationError(
                f'topic {topic}: expected one message type for all inputs from it, got '
                f'{source.message_type} and {kind}'
            )
        source.message_type = source.message_type or kind
        return source

    def open(self) -> None:
        """Open all of them."""
        for source in self._by_topic.values():
            source.open()
        self.on_type()

    def look(self) -> None:
        """Look at the publishers of all topics."""
        for source in self._by_topic.values():
            source.look()

    @property
    def stamps(self) -> set[str]:
        """Which stamps the samples of y have, as far as is known."""
        listeners = [li for source in self._by_topic.values() for li in source.listeners]
        return {li.stamps for li in listeners if li.stamps and li.is_sample}


def find_wanted(types: Mapping[str, Any], wanted: Input) -> Field:
    """Return the field of an input in its message type, or raise ConfigurationError."""
    field = find_field(types, wanted.message_type, wanted.field, wanted.name)
    if wanted.stamp == 'header' and not field.header:
        raise ConfigurationError(
            "parameters 'input_stamp', 'known_input_stamps': expected messages with a header on "
            f'{wanted.topic} for the stamps header, got {wanted.message_type}'
        )
    return field


def check_inputs(node: Node, inputs: Iterable[Input]) -> None:
    """Raise ConfigurationError for names, types or fields that cannot be, as far as given."""
    for wanted in inputs:
        try:
            full_name(node, wanted.topic)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"parameters 'input_topic', 'known_input_topics': {error}"
            ) from None
        if wanted.message_type:
            try:
                find_wanted(definitions(wanted.message_type), wanted)
            except LookupError as error:
                raise ConfigurationError(f"parameter 'input_type': {error}") from None
