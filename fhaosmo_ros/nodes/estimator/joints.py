# SPDX-License-Identifier: Apache-2.0
"""Which joints of a JointState become channels, and which are left out."""

from collections.abc import Collection, Iterable
from textwrap import shorten

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import channel_names, CHANNELS
from fhaosmo_ros.messages.fields import listed
from fhaosmo_ros.nodes.middleware.endpoints import full_name
from fhaosmo_ros.topics import STANDARD_DEVIATION
from rclpy.node import Node


def choose(node: Node, names: Iterable[str], most: int) -> tuple[list[str], str]:
    """Return the names that become channels, at most so many, and what is said of the others."""
    fit: list[str] = []
    bad: dict[str, str] = {}
    said = []
    for name in dict.fromkeys(names):
        try:
            channel_names({CHANNELS: [name or '?']})  # '' is no channel's name
            full_name(node, f'~/{name}/{STANDARD_DEVIATION}')  # its longest topic
            fit.append(name)
        except ConfigurationError as error:
            bad[name] = shorten(str(error), 200)
    if bad:
        said.append(
            f"{left_out(bad)} can't be the name of a channel ({next(iter(bad.values()))}); name a "
            'channel and set its input_field to position[NAME]'
        )
    if fit[most:]:
        said.append(
            f'{left_out(fit[most:])} beyond max_channels ({most}); raise it, or name in channels '
            'those that are to be estimated'
        )
    return fit[:most], '; '.join(said)


def left_out(names: Collection[str]) -> str:
    """Return in words that joints are left out."""
    count = 'joint' if len(names) == 1 else f'{len(names)} joints'
    return f'left out: {count} {listed(map(repr, names))}'
