# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1: their messages in CDR, so that the rest of the package sees bags of ROS 2."""

from collections.abc import Iterator, Sequence
from typing import Any

from fhaosmo_ros.tools.bags.types import TYPES
from rosbags.interfaces import Connection
from rosbags.typesys import get_typestore, Stores

HEADER = 'std_msgs/msg/Header'


def with_header_of_ros2(types: Any) -> Any:
    """Return a typestore in which headers have no `seq`, as ROS 2 has it."""
    result = get_typestore(Stores.EMPTY)
    result.register({**types.fielddefs, HEADER: TYPES.fielddefs[HEADER]})
    return result


class Ros1Storage:
    """
    A ROS 1 bag with the interface of rosbags' storages.

    Parameters
    ----------
    reader : rosbags.rosbag1.Reader
        Open.
    types : typestore
        Of `with_header_of_ros2`.

    """

    def __init__(self, reader: Any, types: Any) -> None:
        self._reader, self._types = reader, types
        self.connections: list[Connection] = list(reader.connections)

    def messages(self, connections: Sequence[Connection]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, stamp (ns) and CDR of the messages of some topics."""
        for connection, stamp, data in self._reader.messages(connections):
            yield connection, stamp, bytes(self._types.ros1_to_cdr(data, connection.msgtype))
