# SPDX-License-Identifier: Apache-2.0
"""Which number a listener takes out of the messages of a topic, and what is wrong with it."""

from collections.abc import Callable, Mapping
import math
from typing import Any, TYPE_CHECKING

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import of_channel
from fhaosmo_ros.inputs import Input, known_inputs, measured_output
from fhaosmo_ros.messages.fields import Field, find_field, MissingElementError, Unwrapper
from fhaosmo_ros.nodes.middleware.definitions import definitions
from fhaosmo_ros.nodes.middleware.publishers import full_name
from rclpy.node import Node

if TYPE_CHECKING:
    from fhaosmo_ros.nodes.estimator.sources import Source

Take = Callable[[int, float, int], None]
"""Gets the stamp of a sample, its value, and when it was published; times in nanoseconds."""


class Listener:
    """
    Somebody who takes one number out of each message of a source.

    Attributes
    ----------
    wanted : Input
    take : callable
        See `Take`.
    is_sample : bool
        True for y, False for a known input, which a message gives first.
    source : Source
    field : Field or None
        None until the topic's type is known.
    error : str
        Why no field can be found in the topic's type, else ''.
    lacking : int
        Messages that lacked the field.
    why : MissingElementError or None
        Why the latest one of them did.

    """

    def __init__(self, wanted: Input, take: Take, source: 'Source', is_sample: bool) -> None:
        self.wanted, self.take, self.source = wanted, take, source
        self.is_sample = is_sample
        self.field: Field | None = None
        self.error = ''
        self.lacking = 0
        self.why: MissingElementError | None = None
        self._kind = 'source'
        self._unwrap: Unwrapper | None = None

    @property
    def stamps(self) -> str:
        """Which stamps its samples have: header, source or reception; '' if not known yet."""
        return self._kind if self.field else ''

    def find(self, types: Mapping[str, Any], message_type: str) -> None:
        """Find its field in a message type, or keep the reason as `error`."""
        wanted, self.field, self.error = self.wanted, None, ''
        try:
            field = find_wanted(types, wanted._replace(message_type=message_type))
        except ConfigurationError as error:
            self.error = str(error)
            return
        self.field = field
        self._kind = wanted.stamp
        if wanted.stamp == 'auto':
            self._kind = 'header' if field.header else 'source'
        self._unwrap = Unwrapper() if field.wraps else None

    def hear(self, message: Any, header: int, info: Mapping[str, Any]) -> bool:
        """
        Pass the number in a message on, NaN where there is no message.

        Returns
        -------
        bool
            False if the message lacks the number; then `why` says why.

        """
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
        source: int = info['source_timestamp']
        if self._kind == 'header':
            self.take(header, value, source)
        elif self._kind == 'source':
            self.take(source, value, source)
        else:
            self.take(info['received_timestamp'], value, source)
        return True


def check_inputs(
    node: Node, values: Parameters, estimators: Mapping[str, OnlineEstimator]
) -> None:
    """
    Raise for inputs that cannot be, as far as their message types are given.

    Parameters
    ----------
    node : Node
        Resolves the names of topics.
    values : Parameters
        Of the node.
    estimators : mapping of str to OnlineEstimator
        By the names of the channels.

    Raises
    ------
    ConfigurationError
        A name that no topic can have, a type that is not installed, or no such field.

    """
    for name, estimator in estimators.items():
        own = of_channel(values, name)
        used = estimator.observer.used_inputs
        for wanted in (measured_output(own, name), *known_inputs(own, used, name).values()):
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


def find_wanted(types: Mapping[str, Any], wanted: Input) -> Field:
    """
    Return the field of an input in its message type.

    Raises
    ------
    ConfigurationError
        There is no such field, or no header where its stamp is asked for.

    """
    field = find_field(types, wanted.message_type, wanted.field, wanted.name)
    if wanted.stamp == 'header' and not field.header:
        raise ConfigurationError(
            "parameters 'input_stamp', 'known_input_stamps': expected messages with a header on "
            f'{wanted.topic} for the stamps header, got {wanted.message_type}'
        )
    return field
