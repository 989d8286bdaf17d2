# SPDX-License-Identifier: Apache-2.0
"""
Parameters of an estimator with many channels: ``hip.lambda`` is channel hip's own ``lambda``.

A channel takes its own value where it has one, else the common value.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
import re
from typing import Any, TypeVar

from fhaosmo_ros.core.parameters.declaration import Parameters, ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import (
    CHANNEL,
    CHANNEL_PARAMETERS,
    CONSTANTS,
    ESTIMATOR_PARAMETERS,
)

Values = TypeVar('Values', bound=Mapping[str, Any])
CHANNELS = 'channels'
UNNAMED = ['']
"""The default: one channel, whose topics and parameters have no prefix."""
FROM_JOINTS = ['from_joint_names']
"""The channels are the joints of a message that is still to come."""
NAME = re.compile(r'[A-Za-z](_?[A-Za-z0-9])*')
"""What is valid between two slashes of a topic and in the name of a parameter."""


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
    if names == UNNAMED:
        return UNNAMED
    for name in names:
        if not NAME.fullmatch(name):
            raise declared.error(names, 'names of letters, digits and single _ between them')
        if name in ESTIMATOR_PARAMETERS or f'{name}.' == CONSTANTS:
            raise declared.error(names, f"names that no parameter has (there is one '{name}')")
    if len(set(names)) < len(names):
        raise declared.error(names, 'every name once')
    return list(names)


def with_own_parameters(names: list[str], values: Iterable[str]) -> list[str]:
    """
    Return the channels whose own parameters may be among `values`: `names`.

    Where these are `FROM_JOINTS`, it is every name that has a parameter of its own: whether there
    is such a joint turns out later.
    """
    if names != FROM_JOINTS:
        return names
    parts = [split(name) for name in values]
    return list(dict.fromkeys(
        start for start, end in parts
        if NAME.fullmatch(start) and start not in ESTIMATOR_PARAMETERS
        and end in CHANNEL_PARAMETERS
    ))  # fmt: skip


def with_channels(names: Iterable[str]) -> ParameterTable:
    """Return the table of an estimator, with each named channel's own parameters."""
    own = [replace(p, name=f'{name}.{p.name}') for name in names if name for p in CHANNEL]
    return ParameterTable(ESTIMATOR_PARAMETERS.values(), ESTIMATOR_PARAMETERS.families, own)


def of_channel(values: Values, name: str) -> Values:
    """
    Return the values of one channel: its own ones, and the common ones for the rest.

    Complete `Parameters` of a node give the complete `Parameters` of a channel, which are not
    checked again. Of other values, those that are absent stay absent.
    """
    common = {key: value for key, value in values.items() if not split(key)[0]}
    own = {split(k)[1]: v for k, v in values.items() if name and split(k)[0] == name}
    if isinstance(values, Parameters):
        return Parameters(ESTIMATOR_PARAMETERS, common | own)  # type: ignore[return-value]
    return common | own  # type: ignore[return-value]


def of_named_channel(values: Values, name: str, what: str) -> Values:
    """Return the values of a channel that a user named; raise of `what` if there is none."""
    names = channel_names(values)
    if name not in names and (names != FROM_JOINTS or not name):
        allowed = 'none, as the node has no channels' if names == UNNAMED else ' or '.join(names)
        raise ConfigurationError(f'{what}: expected {allowed}, got {name or "none"}')
    return of_channel(values, name)


def differing(values: Parameters) -> dict[str, Any]:
    """Return the common values, and of the channels' own those that are not the common ones."""
    return {
        name: value
        for name, value in values.items()
        if not split(name)[0] or value != values.get(split(name)[1])
    }


def followers(name: str, values: Mapping[str, Any]) -> list[str]:
    """Return the channels' own parameters that follow the common one: those of the same value."""
    return [own for own, v in values.items() if split(own)[1] == name != own and v == values[name]]
