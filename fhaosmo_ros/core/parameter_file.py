# SPDX-License-Identifier: Apache-2.0
"""ROS 2 parameter files, read, checked and written without ROS."""

from collections.abc import Iterable, Mapping
from pathlib import Path
import re
from typing import Any

from fhaosmo_ros.core.channel_parameters import channel_names, CHANNELS, with_channels
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import ParameterTable, suggestion, unknown_parameter
from fhaosmo_ros.core.parameters import NODE_TABLES
from fhaosmo_ros.core.yaml_text import parse
import yaml

BUILT_IN = ('use_sim_time', 'start_type_description_service')
"""Parameters that rclpy declares itself."""
DUMPER = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
"""libyaml's is some ten times as fast: a node writes its parameters while samples come."""


def is_built_in(name: str) -> bool:
    """Return True for a parameter that is rclpy's, not ours."""
    return name in BUILT_IN or name.startswith('qos_overrides.')


def load(
    path: str | Path, node: str, table: ParameterTable | None = None, strict: bool = False
) -> dict[str, Any]:
    """
    Return what a parameter file sets for a node of this package.

    Sections that match the node's name are merged in the order of the file, as rcl does. One
    ``/**`` section may serve both nodes, so a name that another node of the package declares is
    passed over.

    Parameters
    ----------
    path : path
        A YAML file of the form ``name: {ros__parameters: {...}}``.
    node : str
        'estimator' or 'plant', or a full name such as '/rig/estimator'.
    table : ParameterTable, optional
        What the node declares; without it, that of the last part of its name.
    strict : bool
        Raise if no section is the node's; ROS passes over such a file.

    Returns
    -------
    dict
        Values by name, checked and in the parameters' own types.

    Raises
    ------
    ConfigurationError
        No such file, not YAML, no ``ros__parameters``, an unknown name or a bad value; the
        message begins with the path.

    """
    try:
        return select(read(path, node, strict), table or NODE_TABLES[node.rsplit('/', 1)[-1]])
    except ConfigurationError as error:
        raise ConfigurationError(f'{path}: {error}') from None


def loads(text: str, node: str, table: ParameterTable) -> dict[str, Any]:
    """Return what the text of a parameter file sets for a node; see `load`."""
    return select(_of_node(_sections(text), node, strict=True), table)


def dumps(values: Mapping[str, Any], node: str = '/**') -> str:
    """
    Return the text of a parameter file that sets these values.

    Parameters
    ----------
    values : mapping
        Of Python's own types.
    node : str
        The section's name: a node's full name, or a pattern.

    """
    content = {node: {'ros__parameters': dict(values)}}
    text = yaml.dump(content, Dumper=DUMPER, sort_keys=False, default_flow_style=None, width=99)
    return str(text)


def read(path: str | Path, node: str, strict: bool = False) -> dict[str, Any]:
    """Return what a file sets for a node, unchecked; see `load`."""
    try:
        text = Path(path).read_text(encoding='utf-8')
    except OSError as error:
        raise ConfigurationError(f'expected a readable file, got: {error.strerror}') from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f'expected YAML, got: {error}') from None
    return _of_node(_sections(text), node, strict)


def _of_node(sections: Mapping[str, Mapping[str, Any]], node: str, strict: bool) -> dict[str, Any]:
    ours = [section for section in sections if _matches(section, node)]
    if strict and not ours:
        names = [section.lstrip('/') for section in sections]
        raise ConfigurationError(
            f"expected a section '{node}' or '/**', got {', '.join(names)}"
            f'{suggestion(node, names)}'
        )
    return {name: value for section in ours for name, value in sections[section].items()}


def select(values: Mapping[str, Any], table: ParameterTable) -> dict[str, Any]:
    """
    Check `values` and return those of `table`, leaving out other nodes' and rclpy's own.

    Raises
    ------
    ConfigurationError
        A name that no node of the package declares, or a bad value.

    """
    names = channel_names(values)
    if CHANNELS in table:
        table = with_channels(table, names)
    tables = [table, *(with_channels(other, names) for other in NODE_TABLES.values())]
    everybody = dict.fromkeys(name for other in tables for name in other)
    for name in values:
        if name not in everybody and not is_built_in(name):
            raise unknown_parameter(name, everybody)
    return dict(table.coerce({k: v for k, v in values.items() if k in table}))


def _sections(text: str) -> dict[str, dict[str, Any]]:
    try:
        content = parse(text)
    except yaml.YAMLError as error:
        problem = ' '.join(str(error).split())
        raise ConfigurationError(f'expected YAML, got: {problem}') from None
    sections: dict[str, dict[str, Any]] = {}
    if isinstance(content, Mapping):
        _collect(content, '', sections)
    if not sections:
        raise ConfigurationError(
            "expected 'NODE: {ros__parameters: {...}}' (NODE is a node's name or /**), "
            f'got {str(content)[:80]!r}'
        )
    return sections


def _collect(content: Mapping[Any, Any], name: str, out: dict[str, dict[str, Any]]) -> None:
    for key, value in content.items():
        if key == 'ros__parameters':
            if not isinstance(value, Mapping):
                raise ConfigurationError(
                    f"section '{name}': expected parameters below ros__parameters, got {value!r}"
                )
            out.setdefault(name, {}).update(_flat(value, ''))
        elif isinstance(value, Mapping):
            _collect(value, f'{name}/{key}', out)
        else:
            raise ConfigurationError(
                f"expected ros__parameters below '{name or key}', got {key!r}: {value!r}"
            )


def _flat(values: Mapping[Any, Any], prefix: str) -> Iterable[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f'{prefix}{key}.')
        else:
            check_one_type(f'{prefix}{key}', value)
            yield f'{prefix}{key}', value


def check_one_type(name: str, value: Any) -> None:
    """Refuse what rcl refuses, in words that help."""
    if isinstance(value, list) and len({type(item) for item in value}) > 1:
        kinds = ' and '.join(sorted({type(item).__name__ for item in value}))
        raise ConfigurationError(
            f"parameter '{name}': expected a list of one type (write 15.0, or quote '0'), "
            f'got {kinds} mixed: {value!r}'
        )


def _matches(section: str, node: str) -> bool:
    """Return True if a section's name covers a node: * is one name, ** any number of them."""
    pattern = '/' + '/'.join(part for part in section.split('/') if part)
    expression = re.escape(pattern).replace(r'/\*\*', '(/[^/]+)*').replace(r'\*', '[^/]+')
    return re.fullmatch(expression, '/' + node.lstrip('/')) is not None
