# SPDX-License-Identifier: Apache-2.0
"""
The parameters of a node, checked as a whole, and those of an estimator with many channels.

``hip.lambda`` is channel hip's own ``lambda``: a channel takes its own value where it has one,
else the common value.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
import re
from typing import Any

from fhaosmo_ros.core.parameters.declaration import Parameters, ParameterTable, unknown_parameter
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import (
    CHANNEL_PARAMETERS,
    CONSTANTS,
    ESTIMATOR_PARAMETERS,
    NODE_TABLES,
)

BUILT_IN = ('use_sim_time', 'start_type_description_service')
"""Parameters that rclpy declares itself."""
CHANNELS = 'channels'
UNNAMED = ['']
"""The default: one channel, whose topics and parameters have no prefix."""
FROM_JOINTS = ['from_joint_names']
"""The channels are the joints of a message that is still to come."""
NAME = re.compile(r'[A-Za-z](_?[A-Za-z0-9])*')
"""What is valid between two slashes of a topic and in the name of a parameter."""


def is_built_in(name: str) -> bool:
    """Return True for a parameter that is rclpy's, not ours."""
    return name in BUILT_IN or name.startswith('qos_overrides.')


def select(values: Mapping[str, Any], table: ParameterTable) -> dict[str, Any]:
    """
    Check `values` and return those of `table`, leaving out other nodes' and rclpy's own.

    Raises ConfigurationError for a name that no node of the package declares, and a bad value.
    """
    estimator = _with_channels(channels_with_own(values))
    if CHANNELS in table:
        table = estimator
    tables = [table, estimator, *NODE_TABLES.values()]
    for name in values:
        if not any(name in other for other in tables) and not is_built_in(name):
            raise unknown_parameter(name, dict.fromkeys(n for other in tables for n in other))
    return {name: table[name].coerce(value) for name, value in values.items() if name in table}


def complete(values: Mapping[str, Any], table: ParameterTable) -> Parameters:
    """
    Check what files and the command line set for a node, each value once; see `select`.

    The channels' own parameters are among the result; they default to the common values.
    """
    checked = select(values, table)
    channels = [name for name in channels_with_own(checked) if name]
    common = table.defaults() | checked
    own = {
        f'{channel}.{name}': value
        for channel in channels
        for name, value in common.items()
        if name in CHANNEL_PARAMETERS
    }
    return Parameters(_with_channels(channels) if channels else table, own | checked)


def split(name: str) -> tuple[str, str]:
    """Return the channel that a parameter's name begins with ('' for none), and the rest."""
    channel, dot, own = name.partition('.')
    return (channel, own) if dot and channel + dot != CONSTANTS else ('', name)


def channel_names(values: Mapping[str, Any]) -> list[str]:
    """
    Return the names of the channels that `values` declare, `UNNAMED` if they declare none.

    A name that is not valid in a topic, that comes twice, or that is a parameter's name raises
    ConfigurationError.
    """
    declared = ESTIMATOR_PARAMETERS[CHANNELS]
    names: Any = declared.coerce(values.get(CHANNELS, UNNAMED))
    for name in names if names != UNNAMED else ():
        if not NAME.fullmatch(name):
            raise declared.error(names, 'names of letters, digits and single _ between them')
        if name in ESTIMATOR_PARAMETERS or f'{name}.' == CONSTANTS:
            raise declared.error(names, f"names that no parameter has (there is one '{name}')")
    if len(set(names)) < len(names):
        raise declared.error(names, 'every name once')
    return names  # type: ignore[no-any-return]


def channels_with_own(values: Mapping[str, Any]) -> list[str]:
    """
    Return the channels whose own parameters may be among `values`.

    Where the names are `FROM_JOINTS`, it is every name that has a parameter of its own: whether
    there is such a joint turns out later.
    """
    names = channel_names(values)
    if names != FROM_JOINTS:
        return names
    parts = [split(name) for name in values if not is_built_in(name)]
    return list(dict.fromkeys(
        channel for channel, own in parts
        if NAME.fullmatch(channel) and channel not in ESTIMATOR_PARAMETERS
        and own in CHANNEL_PARAMETERS
    ))  # fmt: skip


def _with_channels(names: list[str]) -> ParameterTable:
    """Return the table of an estimator, with each named channel's own parameters."""
    of_channel = CHANNEL_PARAMETERS.declared
    own = [replace(p, name=f'{name}.{p.name}') for name in names if name for p in of_channel]
    return ParameterTable(ESTIMATOR_PARAMETERS.declared, own)


def of_channel(values: Mapping[str, Any], name: str) -> Parameters:
    """
    Return the parameters of one channel: its own values, else the common ones, else the defaults.

    `values` have been checked, and are not checked again.
    """
    common = {key: value for key, value in values.items() if not split(key)[0]}
    prefix = f'{name}.'
    own = {key.removeprefix(prefix): v for key, v in values.items() if key.startswith(prefix)}
    return Parameters(ESTIMATOR_PARAMETERS, common | own)


def of_named_channel(
    values: Mapping[str, Any], name: str, what: str, rules: Collection[str] = ()
) -> tuple[str, Parameters]:
    """
    Return name and parameters of a channel that a user named; a single one need not be named.

    Values that a command line has set, by the names in `rules`, win over the channel's own. Raises
    ConfigurationError of `what` if there is none.
    """
    names = channel_names(values)
    if not name and len(names) == 1 and names != FROM_JOINTS:
        (name,) = names
    if name not in names and (names != FROM_JOINTS or not name):
        words = {'': 'none, as the node has no channels', FROM_JOINTS[0]: 'the name of a joint'}
        allowed = ' or '.join(words.get(known, known) for known in names)
        raise ConfigurationError(f'{what}: expected {allowed}, got {name or "none"}')
    beaten = {f'{name}.{rule}' for rule in rules} - set(rules)
    return name, of_channel({k: v for k, v in values.items() if k not in beaten}, name)


def differing(values: Parameters) -> dict[str, Any]:
    """Return the common values, and of the channels' own those that are not the common ones."""
    parts = {name: split(name) for name in values}
    return {
        name: values[name] for name, (channel, common) in parts.items()
        if not channel or values[name] != values.get(common)
    }  # fmt: skip
