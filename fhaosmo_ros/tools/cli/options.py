# SPDX-License-Identifier: Apache-2.0
"""Command-line options that several commands share."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import (
    Parameters,
    ParameterTable,
    unknown_parameter,
)
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import read, select, with_origin
from fhaosmo_ros.core.parameters.per_channel import of_named_channel
from fhaosmo_ros.core.parameters.tables import (
    CHANNEL_PARAMETERS,
    ESTIMATOR_PARAMETERS,
    ONLINE_PARAMETERS,
)
from fhaosmo_ros.core.parameters.yaml_text import parse
from fhaosmo_ros.inputs import with_joints
from fhaosmo_ros.tools.bags.topics import Recorded


def add_value_options(parser: argparse.ArgumentParser, which: str) -> None:
    """Add --params-file, whose help says `which` parameters, and -p."""
    parser.add_argument(
        '--params-file', type=Path, action='append', default=[], metavar='FILE', help=which
    )
    parser.add_argument(
        '-p', '--param', action='append', default=[], metavar='NAME:=VALUE',
        help='set one parameter; wins over files, and over a bag',
    )  # fmt: skip


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --params-file, -p, --node and --channel."""
    add_value_options(
        parser, "parameters of the estimator node, as in 'ros2 run' (default: those in the bag)"
    )
    parser.add_argument(
        '--node', default='estimator', metavar='NAME',
        help='whose sections of the files to take, such as /rig/estimator (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--channel', default='', metavar='NAME',
        help="take the parameters of this one of the node's channels",
    )  # fmt: skip


def channel_parameters(
    arguments: argparse.Namespace, recorded: Recorded | None = None
) -> dict[str, Any]:
    """
    Return the parameters of a channel from the options.

    Parameters
    ----------
    arguments : Namespace
    recorded : Recorded, optional
        What files and -p change.

    Raises
    ------
    ConfigurationError
        A file or a value that can't be used, by itself or together with the others.

    """
    values: dict[str, Any] = {}
    origins: dict[str, Path | str | None] = {}
    given: list[tuple[Path | str | None, Mapping[str, Any]]] = []
    if recorded:
        given.append((f'topic {recorded.topic!r}', recorded.values))
    given += [(path, read(path, arguments.node, strict=True)) for path in arguments.params_file]
    for origin, found in [*given, (None, _on_command_line(arguments))]:
        values |= found
        origins |= dict.fromkeys(found, origin)
    try:
        values = select(values, ESTIMATOR_PARAMETERS)
    except ConfigurationError as error:
        raise with_origin(error, origins) from None
    own = of_named_channel(with_joints(values), arguments.channel, '--channel')
    try:
        OnlineEstimator(Parameters(ESTIMATOR_PARAMETERS, own))
    except ConfigurationError as error:
        raise with_origin(error, origins, arguments.channel) from None
    return CHANNEL_PARAMETERS.part_of(own)


def named(arguments: argparse.Namespace) -> list[str]:
    """Return the parameters of the update path that -p sets."""
    names = [name.removeprefix(f'{arguments.channel}.') for name in _on_command_line(arguments)]
    return [name for name in names if name in ONLINE_PARAMETERS]


def assigned(rules: Sequence[str], table: ParameterTable) -> dict[str, Any]:
    """
    Return the values that NAME:=VALUE rules set, checked by a table.

    Raises
    ------
    ConfigurationError
        A rule that is none, an unknown name, or a bad value.

    """
    values = dict(_rules(rules))
    for name in values:
        if name not in table:
            raise unknown_parameter(name, table)
    return dict(table.coerce(values))


def _on_command_line(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what -p sets of this node; as on a command line of ROS it may be for another."""
    own = ('', arguments.node.strip('/'))
    split = [(target.rpartition(':'), value) for target, value in _rules(arguments.param)]
    return {name: value for (node, _, name), value in split if node.strip('/') in own}


def _rules(rules: Sequence[str]) -> Iterator[tuple[str, Any]]:
    for rule in rules:
        name, separator, text = rule.partition(':=')
        if not separator:
            raise ConfigurationError(f'-p: expected NAME:=VALUE, got {rule!r}')
        try:
            yield name, parse(text)
        except ConfigurationError:
            yield name, text
