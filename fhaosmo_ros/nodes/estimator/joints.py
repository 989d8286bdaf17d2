# SPDX-License-Identifier: Apache-2.0
"""Which joints of a JointState become channels, and which are left out."""

from collections.abc import Iterable
from textwrap import shorten

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import channel_names, CHANNELS
from fhaosmo_ros.messages.fields import listed
from fhaosmo_ros.nodes.middleware.endpoints import full_name
from fhaosmo_ros.topics import STANDARD_DEVIATION
from rclpy.node import Node

MOST_KNOWN = 1000
"""After so many names, new ones are neither looked at nor told any more."""
QUIET = 5.0
"""Seconds between two warnings of joints that have come late."""


class Joints:
    """Checks and bounds the names in messages, and tells of each kind of problem in one line."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._logger = node.get_logger()
        self._known: set[str] = set()
        self._left_out: list[str] = []

    def new(self, names: Iterable[str]) -> list[str]:
        """Return the names that no message has had before."""
        if len(self._known) >= MOST_KNOWN:
            return []
        found = [name for name in dict.fromkeys(names) if name not in self._known]
        self._known.update(found)
        return found

    def choose(self, names: Iterable[str], most: int) -> list[str]:
        """Return those names of the first message that become channels, at most so many."""
        fit: list[str] = []
        bad: dict[str, str] = {}
        for name in names:
            try:
                channel_names({CHANNELS: [name or '?']})  # '' is no channel's name
                full_name(self._node, f'~/{name}/{STANDARD_DEVIATION}')  # its longest topic
                fit.append(name)
            except ConfigurationError as error:
                bad[name] = shorten(str(error), 200)
        if bad:
            why = f"can't be the name of a channel ({next(iter(bad.values()))})"
            hint = 'name a channel and set its input_field to position[NAME]'
            self._logger.error(f'{self._leave_out(list(bad))} {why}; {hint}')
        if fit[most:]:
            why = f'beyond max_channels ({most})'
            hint = 'raise it, or name in channels those that are to be estimated'
            self._logger.error(f'{self._leave_out(fit[most:])} {why}; {hint}')
        return fit[:most]

    def refuse(self, names: list[str]) -> None:
        """Tell that names have come too late to become channels."""
        why = 'has come after the first message; start the node again to take it'
        self._logger.warning(f'{self._leave_out(names)} {why}', throttle_duration_sec=QUIET)

    def _leave_out(self, names: list[str]) -> str:
        self._left_out += names
        return _in_words(names)

    @property
    def problem(self) -> str:
        """What is left out, in words; '' for nothing."""
        return _in_words(self._left_out) if self._left_out else ''


def _in_words(names: list[str]) -> str:
    count = 'joint' if len(names) == 1 else f'{len(names)} joints'
    return f'left out: {count} {listed(map(repr, names))}'
