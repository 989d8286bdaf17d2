# SPDX-License-Identifier: Apache-2.0
"""Command-line options that several commands share."""

import argparse
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.channel_parameters import channel_names, of_channel
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter_file import load, parse, select
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS
import yaml


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --params-file and -p, as a node has them."""
    parser.add_argument(
        '--params-file', type=Path, action='append', default=[], metavar='FILE',
        help="parameters of the estimator node, as in 'ros2 run'",
    )  # fmt: skip
    parser.add_argument(
        '-p', '--param', action='append', default=[], metavar='NAME:=VALUE',
        help='set one parameter; wins over the file',
    )  # fmt: skip
    parser.add_argument(
        '--channel', default='', metavar='NAME',
        help="take the parameters of this one of the node's channels",
    )  # fmt: skip


def online_parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """
    Return the parameters of the update path from the options.

    Raises
    ------
    ConfigurationError
        A file or a value that can't be used.

    """
    values: dict[str, Any] = {}
    for path in arguments.params_file:
        values |= load(path, 'estimator')
    for rule in arguments.param:
        name, separator, text = rule.partition(':=')
        if not separator:
            raise ConfigurationError(f'-p: expected NAME:=VALUE, got {rule!r}')
        try:
            values[name] = parse(text)
        except yaml.YAMLError:
            values[name] = text
    values = select(values, ESTIMATOR_PARAMETERS)
    names = channel_names(values)
    if arguments.channel not in names:
        raise ConfigurationError(
            f'--channel: expected {" or ".join(repr(name) for name in names)}, got '
            f'{arguments.channel!r}'
        )
    own = of_channel(values, arguments.channel)
    return {name: value for name, value in own.items() if name in ONLINE_PARAMETERS}


def named(arguments: argparse.Namespace) -> list[str]:
    """Return the parameters that -p sets."""
    return [rule.partition(':=')[0] for rule in arguments.param]
