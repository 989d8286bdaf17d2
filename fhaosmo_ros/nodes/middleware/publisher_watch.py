# SPDX-License-Identifier: Apache-2.0
"""The publishers of a subscribed topic, and why messages of some of them do not arrive."""

from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import qos_check_compatible, QoSCompatibility, QoSProfile

UNKNOWN = '_NODE_NAME_UNKNOWN_'
"""The name of a node that has been discovered later than its publisher, or is none of ROS."""


class Publishers(NamedTuple):
    """The publishers of a topic, by their gid."""

    heard: dict[tuple[int, ...], str]
    """Node names of those that can be heard."""
    unheard: dict[tuple[int, ...], str]
    """For each of the others, a sentence that names the node and says what to do about it."""


class PublisherWatch:
    """
    Looks at the publishers of a subscription's topic, and logs what has changed.

    The middleware has an event for incompatible QoS, but it does not name the publisher, and there
    is none for another message type. The ROS graph has both.
    """

    def __init__(self, node: Node, topic: str, message_type: str, qos: QoSProfile) -> None:
        self._node, self._topic, self._type, self._qos = node, topic, message_type, qos
        self._logger = node.get_logger()
        self._seen = Publishers({}, {})
        self._last: dict[tuple[int, ...], str] = {}
        self._nameless: set[tuple[int, ...]] = set()

    def look(self) -> Publishers:
        """Return the present publishers."""
        found = Publishers({}, {})
        for endpoint in self._node.get_publishers_info_by_topic(self._topic):
            gid = tuple(endpoint.endpoint_gid)
            if endpoint.node_name == UNKNOWN and gid not in self._nameless:
                self._nameless.add(gid)  # its node is usually known at the next look
                continue
            name = f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'
            reason = self._mismatch(endpoint)
            if reason:
                found.unheard[gid] = f'{name} publishes {self._topic} unheard: {reason}'
            else:
                found.heard[gid] = name
        self._tell(found)
        self._seen = found
        return found

    def _mismatch(self, endpoint: Any) -> str:
        if endpoint.topic_type != self._type:
            return f'its type is {endpoint.topic_type}, expected {self._type}'
        verdict, reason = qos_check_compatible(endpoint.qos_profile, self._qos)
        if verdict != QoSCompatibility.ERROR:
            return ''
        clashes = [part.removeprefix('ERROR: ') for part in reason.split(';') if 'ERROR' in part]
        return (
            f'{", ".join(clashes).lower()}; change input_reliability or input_durability, or its '
            'own QoS'
        )

    def _tell(self, found: Publishers) -> None:
        for gid, text in found.unheard.items():
            if self._seen.unheard.get(gid) != text:
                self._logger.error(text)
        if found.heard and found.heard.keys() != self._seen.heard.keys():
            names = ' and '.join(sorted(found.heard.values()))
            if len(found.heard) > 1:
                self._logger.warning(
                    f'{len(found.heard)} publishers of {self._topic}, their samples mix: {names}'
                )
            elif self._last and self._last.keys() != found.heard.keys():
                self._logger.warning(f'the publisher of {self._topic} changed: now {names}')
            self._last = found.heard
