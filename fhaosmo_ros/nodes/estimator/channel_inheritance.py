# SPDX-License-Identifier: Apache-2.0
"""A channel's parameters change along with the common ones, until they are set themselves."""

from collections.abc import Collection, Iterable

from fhaosmo_ros.core.parameters.per_channel import followers, split


class ChannelInheritance:
    """
    Says which parameters of channels change along with the common ones.

    Parameters
    ----------
    channels : list of str
        Names of the channels.
    given : iterable of str
        Parameters that files and the command line have set.

    """

    def __init__(self, channels: list[str], given: Iterable[str]) -> None:
        self._channels = channels
        self._own = {name for name in given if split(name)[0]}
        self._asked: set[str] = set()

    def followers(self, names: Collection[str]) -> dict[str, str]:
        """Return the parameters that change along if `names` are set, and what each follows."""
        self._asked = {name for name in names if split(name)[0]}
        own = self._own | self._asked
        return {
            follower: name for name in names for follower in followers(name, self._channels, own)
        }

    def adopt(self) -> None:
        """Remember that ROS has accepted the latest names: these no longer follow."""
        self._own |= self._asked
