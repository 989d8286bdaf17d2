# SPDX-License-Identifier: Apache-2.0
"""The command line of a node: its parameters, read once and by us, and its help."""

import argparse
from itertools import pairwise
import os
import re
import textwrap
from typing import Any

from fhaosmo_ros.core.parameters.declaration import shown, unknown_parameter
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import read
from fhaosmo_ros.core.parameters.per_channel import is_built_in
from fhaosmo_ros.core.parameters.tables import NODE_TABLES
from fhaosmo_ros.core.parameters.yaml_text import parse_rule
from rclpy.logging import get_logger
from rclpy.utilities import remove_ros_args

USAGE = '[--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r FROM:=TO] ...]'
Origins = dict[str, str | None]
"""By the name of a parameter: the file that sets it, None for the command line."""


def read_arguments(name: str, argv: list[str]) -> tuple[dict[str, Any], Origins, list[str]]:
    """
    Read the parameters of a node; those of the command line win over those of files.

    Returns parameters by name, which are not checked yet, their origins, and the arguments that
    are left for ROS, such as remappings. Raises ConfigurationError for a file that can't be read,
    no section for the node but a similar one, a value that is no YAML, or an argument that no node
    has.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument('--params-file', action='append', default=[])
    parser.add_argument('-p', '--param', action='append', default=[])
    of_ros = '--ros-args' in argv
    try:
        found, rest = parser.parse_known_args(argv if of_ros else [])
    except argparse.ArgumentError as error:
        raise ConfigurationError(str(error)) from None
    full_name = _full_name(name, rest)
    given: dict[str, Any] = {}
    origins: Origins = {}
    for path in map(os.path.expanduser, found.params_file):
        values = read(path, full_name)
        if not values:
            get_logger(name).warning(f'{path}: sets nothing for node {full_name}')
        given |= values
        origins |= dict.fromkeys(values, path)
    for rule in found.param:
        target, value = parse_rule(rule)
        node, _, parameter = target.rpartition(':')
        if node and node != full_name.rsplit('/', 1)[-1]:
            continue  # one command line may serve several nodes
        # A file may hold the parameters of another node of the package, too; a rule may not.
        table = NODE_TABLES[name]
        if not (is_built_in(parameter) or '.' in parameter or parameter in table):
            raise unknown_parameter(parameter, table)
        given[parameter], origins[parameter] = value, None
    others = remove_ros_args([name, *(rest if of_ros else argv)])[1:]
    if others:
        raise ConfigurationError(
            f'unexpected argument {others[0]!r}; usage: {name} {USAGE}; parameters: {name} --help'
        )
    return given, origins, rest


def _full_name(name: str, arguments: list[str]) -> str:
    """Return the node's name after the renaming that the command line asks for."""
    namespace = ''
    for flag, word in pairwise(arguments):
        rule = re.fullmatch(r'(?:[^:]+:)?__(node|name|ns):=(.+)', word)
        if flag in ('-r', '--remap') and rule:
            namespace, name = (rule[2], name) if rule[1] == 'ns' else (namespace, rule[2])
    return f'{namespace.rstrip("/")}/{name}'


def help_of(name: str) -> str:
    """Return the help of a node: all parameters, with their defaults and what is allowed."""
    lines = [f'usage: {name} {USAGE}', '', 'Parameters and their defaults:', '']
    for p in NODE_TABLES[name].declared:
        lines.append(f'{p.name}: {shown(p.default)}')
        lines += textwrap.wrap(f'    {p.text} ({p.allowed})', 99, subsequent_indent=' ' * 4)
    return '\n'.join(lines)
