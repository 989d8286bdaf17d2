# SPDX-License-Identifier: Apache-2.0
"""
Parameters of an estimator with many channels: ``hip.lambda`` is channel hip's own ``lambda``.

A channel takes what it has of its own, else the common value. So a table of m channels is the
common table and m prefixed copies of it.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
import re
from typing import Any

from fhaosmo_ros.core.parameter import Parameter, ParameterTable
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS

CHANNELS = 'channels'
UNNAMED = ['']
"""The default: one channel, whose topics and parameters have no prefix."""
NAME = re.compile(r'[A-Za-z](_?[A-Za-z0-9])*')
"""What may stand in a topic, between two slashes, and in a parameter's name."""


def channel_names(values: Mapping[str, Any]) -> list[str]:
    """
    Return the names of the channels that `values` declare, `UNNAMED` if they declare none.

    Raises
    ------
    ConfigurationError
        A name that can't stand in a topic, that comes twice, or that a parameter has.

    """
    declared = ESTIMATOR_PARAMETERS[CHANNELS]
    names: Any = declared.coerce(values.get(CHANNELS, UNNAMED))
    if names == UNNAMED:
        return UNNAMED
    for name in names:
        if not NAME.fullmatch(name):
            raise declared.error(names, 'names of letters, digits and single _ between them')
        if name in ESTIMATOR_PARAMETERS:
            raise declared.error(names, f"names that no parameter has (there is one '{name}')")
    if len(set(names)) < len(names):
        raise declared.error(names, 'every name once')
    return list(names)


def with_channels(
    table: Mapping[str, Parameter], names: Iterable[str], values: Mapping[str, Any] | None = None
) -> ParameterTable:
    """
    Return `table` and, for each named channel, its own parameters.

    Parameters
    ----------
    table : mapping
        The common parameters; those of the update path get a copy for each channel.
    names : iterable of str
        As `channel_names` returns them.
    values : mapping, optional
        Checked common values: what a channel's own parameters default to.

    """
    values = values or {}
    own = [
        replace(p, name=f'{name}.{p.name}', default=values.get(p.name, p.default))
        for name in names if name
        for p in table.values() if p.name in ONLINE_PARAMETERS
    ]  # fmt: skip
    return ParameterTable(table.values(), own)


def of_channel(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a channel's values: the common ones, and its own in their place."""
    common = {key: value for key, value in values.items() if '.' not in key}
    start = f'{name}.'
    own = {k.removeprefix(start): v for k, v in values.items() if name and k.startswith(start)}
    return common | own


def differing(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the common values, and of the channels' own those that are not the common ones."""
    return {
        name: value for name, value in values.items()
        if '.' not in name or value != values[name.rpartition('.')[2]]
    }  # fmt: skip


def followers(name: str, names: Iterable[str], own: Collection[str]) -> list[str]:
    """Return the channels' parameters that follow the common one called `name`."""
    if name not in ONLINE_PARAMETERS:
        return []
    prefixed = [f'{channel}.{name}' for channel in names if channel]
    return [parameter for parameter in prefixed if parameter not in own]
