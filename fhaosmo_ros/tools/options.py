# SPDX-License-Identifier: Apache-2.0
"""Command-line options that several commands share."""

import argparse
from pathlib import Path
import re
from typing import Any

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameter import unknown_parameter
from fhaosmo_ros.core.parameter_file import load, parse
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS
import yaml


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --params-file, -p and --node, as a node has them."""
    parser.add_argument(
        '--params-file', type=Path, action='append', default=[], metavar='FILE',
        help="parameters of the estimator node, as in 'ros2 run'",
    )  # fmt: skip
    parser.add_argument(
        '-p', '--param', action='append', default=[], metavar='NAME:=VALUE',
        help='set one parameter; wins over the file',
    )  # fmt: skip
    parser.add_argument(
        '--node', default='estimator', metavar='NAME',
        help='whose sections of the files to take, such as /rig/estimator (default: %(default)s)',
    )  # fmt: skip


def online_parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """
    Return the parameters of the update path from the options.

    Raises
    ------
    ConfigurationError
        A file or a value that can't be used, by itself or together with the others.

    """
    values: dict[str, Any] = {}
    origin: dict[str, Path | None] = {}
    for path in arguments.params_file:
        of_file = load(path, arguments.node, ESTIMATOR_PARAMETERS, strict=True)
        values |= of_file
        origin |= dict.fromkeys(of_file, path)
    on_command_line = _on_command_line(arguments)
    values |= on_command_line
    origin |= dict.fromkeys(on_command_line)
    values = {name: value for name, value in values.items() if name in ONLINE_PARAMETERS}
    try:
        OnlineEstimator(values)
    except ConfigurationError as error:
        named = re.match(r"parameter '([^']+)'", str(error))
        path = origin.get(named[1]) if named else None
        raise ConfigurationError(f'{path}: {error}' if path else str(error)) from None
    return values


def named(arguments: argparse.Namespace) -> list[str]:
    """Return the parameters that -p sets."""
    return list(_on_command_line(arguments))


def _on_command_line(arguments: argparse.Namespace) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for rule in arguments.param:
        target, separator, text = rule.partition(':=')
        if not separator:
            raise ConfigurationError(f'-p: expected NAME:=VALUE, got {rule!r}')
        node, _, name = target.rpartition(':')
        if node and node.strip('/') != arguments.node.strip('/'):
            continue  # another node's, as on a command line of ROS
        if name not in ESTIMATOR_PARAMETERS:
            raise unknown_parameter(name, ESTIMATOR_PARAMETERS)
        try:
            value = parse(text)
        except yaml.YAMLError:
            value = text
        values[name] = ESTIMATOR_PARAMETERS[name].coerce(value)
    return values
