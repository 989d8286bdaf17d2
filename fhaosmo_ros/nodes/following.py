# SPDX-License-Identifier: Apache-2.0
"""A channel's parameters follow the common ones, until they are set themselves."""

from collections.abc import Iterable, Mapping
from typing import Any

from fhaosmo_ros.core.channel_parameters import followers
from rclpy.parameter import Parameter as RosParameter


class Following:
    """
    Says which parameters change along with others.

    Parameters
    ----------
    channels : list of str
        Names of the channels.
    given : iterable of str
        Parameters that somebody has set at the start.

    """

    def __init__(self, channels: list[str], given: Iterable[str]) -> None:
        self._channels = channels
        self._own = {name for name in given if '.' in name}
        self._asked: set[str] = set()

    def complete(self, parameters: list[RosParameter]) -> list[RosParameter]:
        """Return what somebody sets, and behind it what follows."""
        self._asked = {p.name for p in parameters if '.' in p.name}
        own = self._own | self._asked
        return parameters + [
            RosParameter(name, p.type_, p.value)
            for p in parameters
            for name in followers(p.name, self._channels, own)
        ]

    def adopted(self, changes: Mapping[str, Any]) -> None:
        """Remember that what was asked for has come to pass."""
        self._own |= self._asked & changes.keys()
