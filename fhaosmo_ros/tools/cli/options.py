# SPDX-License-Identifier: Apache-2.0
"""Command-line options that several commands share."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters, ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import read, with_origin
from fhaosmo_ros.core.parameters.per_channel import of_named_channel, select
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
) -> Parameters:
    """
    Return the parameters of a channel: those `recorded`, changed by files, and these by -p.

    Raises
    ------
    ConfigurationError
        A file or a value that can't be used, by itself or together with the others.

    """
    given: list[tuple[Any, dict[str, Any]]] = []
    if recorded:
        given.append((f'topic {recorded.topic!r}', recorded.values))
    given += [(path, read(path, arguments.node, strict=True)) for path in arguments.params_file]
    values: dict[str, Any] = {}
    origins: dict[str, Any] = {}
    for origin, found in [*given, (None, dict(_rules(arguments.param)))]:
        values |= found
        origins |= dict.fromkeys(found, origin)
    try:
        values = select(values, ESTIMATOR_PARAMETERS)
    except ConfigurationError as error:
        raise with_origin(error, origins) from None
    own = of_named_channel(with_joints(values), arguments.channel, '--channel')
    parameters = CHANNEL_PARAMETERS.complete(own)
    try:
        OnlineEstimator(parameters)
    except ConfigurationError as error:
        raise with_origin(error, origins, arguments.channel) from None
    return parameters


def named(arguments: argparse.Namespace) -> list[str]:
    """Return the parameters of the update path that -p sets."""
    names = [name.removeprefix(f'{arguments.channel}.') for name, _ in _rules(arguments.param)]
    return [name for name in names if name in ONLINE_PARAMETERS]


def assigned(rules: Sequence[str], table: ParameterTable) -> dict[str, Any]:
    """
    Return the values that NAME:=VALUE rules set, checked by a table.

    Raises
    ------
    ConfigurationError
        A rule that is none, an unknown name, or a bad value.

    """
    return table.coerce(dict(_rules(rules)))


def _rules(rules: Sequence[str]) -> Iterator[tuple[str, Any]]:
    for rule in rules:
        name, separator, text = rule.partition(':=')
        if not separator:
            raise ConfigurationError(f'-p: expected NAME:=VALUE, got {rule!r}')
        try:
            yield name, parse(text)
        except ConfigurationError:
            yield name, text
