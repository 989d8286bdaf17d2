# SPDX-License-Identifier: Apache-2.0
"""
Subscriptions that channels share: one for each topic, and one look at each of its messages.

The type of a topic is given, or found from the graph: then the subscription begins once somebody
publishes it, and begins anew if the publisher returns with another type.
"""

from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.inputs import Input
from fhaosmo_ros.nodes.estimator.listener import Listener, Take
from fhaosmo_ros.nodes.middleware.definitions import definitions
from fhaosmo_ros.nodes.middleware.messages import message_class
from fhaosmo_ros.nodes.middleware.publisher_watch import Publishers, PublisherWatch
from fhaosmo_ros.nodes.middleware.subscription import subscribe_with_info
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

DISCOVERY_PERIOD = 0.2
FRESH = 0.2
"""Seconds for which what was seen of the publishers serves further channels."""
MOST_WHYS = 3
"""Different reasons that are told, of a publisher that always has another one."""
NOBODY = Publishers({}, {})


class Source:
    """
    A topic and all that its messages are read for.

    Parameters
    ----------
    node : Node
    wanted : Input
        Its topic and message type.
    qos : QoSProfile

    Attributes
    ----------
    topic : str
        Full name, after remapping.
    message_type : str
        '' while it is not known.
    lost : int
        Messages missing between the publisher's sequence numbers.
    damaged : int
        Messages that are shorter than their type.

    """

    def __init__(self, node: Node, wanted: Input, qos: QoSProfile) -> None:
        self._node, self._qos = node, qos
        self._logger = node.get_logger()
        self.topic = node.resolve_topic_name(wanted.topic)
        self.message_type = wanted.message_type
        self._from_graph = not wanted.message_type
        self.lost = self.damaged = 0
        self._sequence = 0
        self._mixed = False
        self._listeners: list[Listener] = []
        self.after: Callable[[], None] | None = None
        """Called after each message."""
        self._heard: list[Listener] = []  # those with a field
        self._whys: set[str] = set()
        self._subscription: Any = None
        self._watch: PublisherWatch | None = None
        self._seen, self._seen_at = NOBODY, -FRESH
        self._told = ''
        self._timer: Any = None
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.on_names: Callable[[list[str]], None] | None = None
        """Called with the names in a message when they are not those of the one before."""
        self.on_type: Callable[[], None] = lambda: None
        self._names: list[str] = []

    def expect_type(self, message_type: str) -> None:
        """
        Take a message type that was given, '' for any.

        Raises
        ------
        ConfigurationError
            Another one was given before.

        """
        if self.message_type and message_type not in ('', self.message_type):
            raise ConfigurationError(
                f'topic {self.topic}: expected one message type for all inputs from it, got '
                f'{self.message_type} and {message_type}'
            )
        if message_type and not self.message_type:
            self.message_type, self._from_graph = message_type, False

    def add(self, wanted: Input, take: Take, first: bool = False) -> Listener:
        """Add a listener; a `first` one hears a message before those that are not."""
        listener = Listener(wanted, take, self, is_sample=not first)
        if first:
            self._listeners.insert(0, listener)
        else:
            self._listeners.append(listener)
        return listener

    def open(self) -> None:
        """
        Subscribe, now or once the type of the topic is known.

        Raises
        ------
        ConfigurationError
            A type that was given is not installed, or it does not have a listener's field.

        """
        if self._subscription is not None:
            self._find_fields()
            self._expect_fields()
        elif self.message_type:
            try:
                self._subscribe(self.message_type)
            except LookupError as error:
                raise ConfigurationError(f"parameter 'input_type': {error}") from None
            self._expect_fields()
        elif self._listeners or self.on_names:
            self._begin_discovery()
            self._discover()

    def _expect_fields(self) -> None:
        for listener in self._listeners:
            if listener.error:
                raise ConfigurationError(listener.error)

    def close(self) -> None:
        """Take the subscription away."""
        self._end_discovery()
        self._unsubscribe()
        self._listeners, self._heard, self.after = [], [], None

    def forget(self) -> None:
        """Expect a publisher that numbers its messages anew."""
        self._sequence, self._mixed = 0, False

    def look(self) -> Publishers:
        """Return the topic's publishers; begin anew if its type has changed."""
        if monotonic() - self._seen_at < FRESH:
            return self._seen
        self._seen_at = monotonic()
        self._seen = self._watch.look() if self._watch else NOBODY
        self._mixed = len(self._seen.heard) > 1
        if self._from_graph and self._watch and not self._seen.heard and self._seen.unheard:
            kinds = self._kinds()
            if kinds and self.message_type not in kinds:
                self._logger.warning(
                    f'the type of {self.topic} changed from {self.message_type} to {kinds[0]}'
                )
                self._unsubscribe()
                # Not at once: the executor lets go of the old subscription a little later, and
                # the middleware has one type for each topic of a process.
                self._begin_discovery()
        return self._seen

    @property
    def stamps(self) -> set[str]:
        """Which stamps its listeners' samples of y have, as far as is known."""
        return {li.stamps for li in self._listeners if li.stamps and li.is_sample}

    def _kinds(self) -> list[str]:
        found = self._node.get_publishers_info_by_topic(self.topic)
        return sorted({endpoint.topic_type for endpoint in found})

    def _discover(self) -> None:
        kinds = self._kinds()
        if kinds:
            self._take_type(kinds[0])

    def _take_type(self, message_type: str) -> None:
        """Subscribe with a type that was found; say once why if that is not possible."""
        problems: list[str] = []
        try:
            self._subscribe(message_type)
            self._end_discovery()
            self.on_type()
            problems = [listener.error for listener in self._listeners if listener.error]
        except (LookupError, rclpy_implementation.RCLError) as error:
            problems = [f'{self.topic}: {error}']
            for listener in self._listeners:
                listener.field, listener.error = None, problems[0]
            self._begin_discovery()
        text = '; '.join(dict.fromkeys(problems))
        if text and text != self._told:
            self._logger.error(text)
        self._told = text

    def _begin_discovery(self) -> None:
        if self._timer is None:
            self._timer = self._node.create_timer(
                DISCOVERY_PERIOD, self._discover, clock=self._steady
            )

    def _end_discovery(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def _subscribe(self, message_type: str) -> None:
        self._class = message_class(message_type)
        self._types = definitions(message_type)
        self.message_type = message_type
        self._find_fields()
        self.forget()
        self._subscription = subscribe_with_info(
            self._node, self._class, self.topic, self._on_message, self._qos, raw=True
        )
        self._watch = PublisherWatch(self._node, self._subscription)
        self._seen_at = -FRESH

    def _find_fields(self) -> None:
        for listener in self._listeners:
            listener.find(self._types, self.message_type)
        self._heard = [listener for listener in self._listeners if listener.field]

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscription = self._watch = None
        self._heard = []

    def _on_message(self, data: bytes, info: Mapping[str, Any]) -> None:
        sequence = info['publication_sequence_number'] or 0  # 0: the middleware has none
        if sequence != self._sequence + 1:
            self._count_lost(sequence)
        self._sequence = sequence
        message, header = None, 0
        try:
            message = deserialize_message(data, self._class)
        except RuntimeError:  # in a subscription that is not raw it would end the node
            self.damaged += 1
        else:
            self._tell_names(message)
            if self._heard and self._heard[0].field.header:
                header = self._heard[0].field.stamp(message)
        lacking = [li for li in self._heard if not li.hear(message, header, info)]
        if lacking and len(self._whys) < MOST_WHYS:
            self._tell_lacking(lacking)
        if self.after is not None:
            self.after()

    def _tell_names(self, message: Any) -> None:
        if self.on_names is not None:
            names = getattr(message, 'name', None)
            if names and isinstance(names, list) and names != self._names:
                self._names = names
                self.on_names(names)

    def _tell_lacking(self, lacking: list[Listener]) -> None:
        """Tell why a message lacks the field of some listeners, in one line, once a reason."""
        why = str(lacking[0].why)
        if why not in self._whys:  # two publishers may alternate
            self._whys.add(why)
            more = f' (and {len(lacking) - 1} more like it)' if lacking[1:] else ''
            self._logger.warning(f'a message on {self.topic} is left out: {why}{more}')

    def _count_lost(self, sequence: int) -> None:
        """Count the messages between the publisher's last sequence number and this one."""
        if 0 < sequence <= self._sequence:  # another publisher's
            self._mixed = True  # until `look` has seen how many there are
        elif sequence and self._sequence and not self._mixed:
            self.lost += sequence - self._sequence - 1


class Sources:
    """
    The sources of a node: one for each topic.

    Parameters
    ----------
    node : Node
    qos : QoSProfile
        Of all subscriptions.
    on_type : callable
        Called when the type of a topic has become known.

    """

    def __init__(
        self, node: Node, qos: QoSProfile, on_type: Callable[[], None] = lambda: None
    ) -> None:
        self._node, self._qos, self._on_type = node, qos, on_type
        self._by_topic: dict[str, Source] = {}
        self._after: Callable[[], None] | None = None

    def after_message(self, call: Callable[[], None]) -> None:
        """Have something called after each message, once they are open."""
        self._after = call

    def of(self, wanted: Input) -> Source:
        """
        Return the source that an input is read from; new ones are not open yet.

        Raises
        ------
        ConfigurationError
            Another input is read from the same topic with another type.

        """
        topic = self._node.resolve_topic_name(wanted.topic)
        if topic not in self._by_topic:
            self._by_topic[topic] = Source(self._node, wanted, self._qos)
        source = self._by_topic[topic]
        source.expect_type(wanted.message_type)
        return source

    def open(self) -> None:
        """
        Open all of them.

        Raises
        ------
        ConfigurationError
            As `Source.open`.

        """
        for source in self._by_topic.values():
            source.after, source.on_type = self._after, self._on_type
            source.open()
        self._on_type()

    @property
    def stamps(self) -> set[str]:
        """Which stamps the samples of y have, as far as is known."""
        return {stamps for source in self._by_topic.values() for stamps in source.stamps}

    def close(self) -> None:
        """Take all subscriptions away."""
        while self._by_topic:
            self._by_topic.popitem()[1].close()

    def forget(self) -> None:
        """Expect publishers that number their messages anew."""
        for source in self._by_topic.values():
            source.forget()
