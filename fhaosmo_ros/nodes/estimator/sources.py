# SPDX-License-Identifier: Apache-2.0
"""
Subscriptions that channels share: one for each topic, and one look at each of its messages.

The type of a topic is given, or found from the graph: then the subscription begins once somebody
publishes a type that has a wanted field.
"""

from collections.abc import Callable, Mapping
from copy import copy
import math
from time import time_ns
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.inputs import Input
from fhaosmo_ros.messages.fields import Field, find_field, MissingElementError, Unwrapper
from fhaosmo_ros.nodes.middleware import endpoints
from fhaosmo_ros.nodes.middleware.messages import definitions, message_class
from rclpy.node import Node

Take = Callable[[int, float], None]
"""Gets the stamp of a sample in nanoseconds, and its value."""


class Listener:
    """
    Takes one number out of each message of a source.

    `field` and `stamps` (header, source or reception) are not known before the topic's type;
    `error` says why its type has no such field. `lacking` messages were without it; `why`: the
    latest one of them.
    """

    def __init__(self, wanted: Input, take: Take, source: 'Source') -> None:
        self.wanted, self.take, self.source = wanted, take, source
        self.field: Field | None = None
        self.stamps = self.error = self.why = ''
        self.lacking = 0

    def find(self, types: Mapping[str, Any], message_type: str) -> None:
        """Find its field in a message type, or keep the reason as `error`."""
        self.error, self.field = '', None
        try:
            self.field = field = find_wanted(types, self.wanted, message_type)
        except ConfigurationError as error:
            self.error = str(error)
            return
        self.stamps = self.wanted.stamp
        if self.stamps == 'auto':
            self.stamps = 'header' if field.header else 'source'
        unwrap = Unwrapper()
        self.value = (lambda message: unwrap(field.value(message))) if field.wraps else field.value


class Source:
    """
    A topic and all that its messages are read for.

    `message_type` is '' while it is not known. Of the publishers that `look` has seen, `heard` are
    the nodes that publish this type; `unheard` has a sentence on each other one. `numbers.lost`
    messages did not arrive, or were damaged, which the middleware drops. `delay` is the longest
    time from a publication to its callback between the latest two looks (ns), `offset` that from
    the latest header's stamp to its publication.
    """

    def __init__(self, node: Any, topic: str) -> None:
        self._node, self.topic = node, topic
        self.message_type = ''
        self.heard: list[str] = []
        self.unheard: list[str] = []
        self.numbers, self.offset = endpoints.SequenceNumbers(), 0
        self.delay = self._delay = -math.inf
        self.listeners: list[Listener] = []
        self._served: list[Listener] = []  # those with a field
        self._header = ''  # its name in a message
        self._subscription: Any = None

    def _open(self) -> None:
        """Look for fields in the type, if it is known, and subscribe if there is one."""
        message_type = self.message_type
        if not message_type:
            found = self._node.get_publishers_info_by_topic(self.topic)
            message_type = min((end.topic_type for end in found), default='')
        if not message_type:
            return
        try:
            kind, types = message_class(message_type), definitions(message_type)
            for listener in self.listeners:
                listener.find(types, message_type)
            self._served = [listener for listener in self.listeners if listener.field]
            self._header = next((li.field.header for li in self._served), '')
            if self._served:
                self.message_type = message_type
                self._subscription = endpoints.subscribe_with_info(
                    self._node, kind, self.topic, self._on_message, copy(endpoints.SENSOR_QOS),
                    qos_overriding_options=endpoints.OVERRIDABLE,
                )  # fmt: skip
        except (LookupError, RuntimeError) as error:  # not installed here; rcl's
            for listener in self.listeners:
                listener.error = f'{self.topic}: {error}'

    def look(self) -> None:
        """Look at the topic's publishers in the ROS graph; rclpy logs QoS that does not match."""
        if self._subscription is None:
            self._open()
            return
        self.delay, self._delay = self._delay, -math.inf
        self.heard, self.unheard = [], []
        for endpoint in self._node.get_publishers_info_by_topic(self.topic):
            name = f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'
            if endpoint.topic_type == self.message_type:
                self.heard.append(name)
            else:
                self.unheard.append(
                    f'{name} publishes {self.topic} unheard: its type is {endpoint.topic_type}, '
                    f'expected {self.message_type}'
                )
        self.numbers.single = len(self.heard) <= 1

    def _on_message(self, message: Any, info: Mapping[str, Any]) -> None:
        published = info['source_timestamp']
        self._delay = max(self._delay, time_ns() - published)
        self.numbers.take(info)
        stamps = {'source': published, 'reception': info['received_timestamp']}
        if self._header:
            stamp = getattr(message, self._header).stamp
            stamps['header'] = header = stamp.sec * 1_000_000_000 + stamp.nanosec
            self.offset = published - header if header else 0
        for listener in self._served:
            try:
                value = listener.value(message)
            except MissingElementError as error:
                listener.lacking += 1
                listener.why = str(error)
            else:
                listener.take(stamps[listener.stamps], value)
        self._node.typed.publish()


def listen(node: Any, wanted: Input, take: Take) -> Listener:
    """
    Return a listener to an input, at the one of the node's `sources` that is of its topic.

    It hears a message after those that were made before. Raises ConfigurationError for a second
    type of a topic.
    """
    topic, kind = node.resolve_topic_name(wanted.topic), wanted.message_type
    source = node.sources.setdefault(topic, Source(node, topic))
    if kind and source.message_type not in ('', kind):
        raise ConfigurationError(
            f'topic {topic}: expected one message type for all inputs from it, got '
            f'{source.message_type} and {kind}'
        )
    source.message_type = source.message_type or kind
    source.listeners.append(Listener(wanted, take, source))
    return source.listeners[-1]


def find_wanted(types: Mapping[str, Any], wanted: Input, message_type: str) -> Field:
    """Return the field of an input in a message type, or raise ConfigurationError."""
    field = find_field(types, message_type, wanted.field, wanted.name)
    if wanted.stamp == 'header' and not field.header:
        raise ConfigurationError(
            f"parameter 'input_stamp': expected messages with a header on {wanted.topic} for the "
            f'stamps header, got {message_type}'
        )
    return field


def check_input(node: Node, wanted: Input) -> None:
    """Raise ConfigurationError for a name, a type or a field that cannot be, as far as given."""
    endpoints.full_name(node, wanted.topic, "parameters 'input_topic', 'known_input_topics': ")
    if wanted.message_type:
        try:
            find_wanted(definitions(wanted.message_type), wanted, wanted.message_type)
        except LookupError as error:
            types = "parameter 'input_type' or 'known_input_types'"
            raise ConfigurationError(f'{types}: {error}') from None
