# SPDX-License-Identifier: Apache-2.0
"""Command-line options that several commands share."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import ParameterTable, unknown_parameter
from fhaosmo_ros.core.parameter_file import load, parse
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
    values |= assigned(arguments.param, ESTIMATOR_PARAMETERS)
    return {name: value for name, value in values.items() if name in ONLINE_PARAMETERS}


def assigned(rules: Sequence[str], table: ParameterTable) -> dict[str, Any]:
    """
    Return the values that NAME:=VALUE rules set, checked by a table.

    Raises
    ------
    ConfigurationError
        A rule that is none, an unknown name, or a bad value.

    """
    values = {}
    for rule in rules:
        name, separator, text = rule.partition(':=')
        if not separator:
            raise ConfigurationError(f'-p: expected NAME:=VALUE, got {rule!r}')
        if name not in table:
            raise unknown_parameter(name, table)
        try:
            value = parse(text)
        except yaml.YAMLError:
            value = text
        values[name] = table[name].coerce(value)
    return values
