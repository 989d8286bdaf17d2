# SPDX-License-Identifier: Apache-2.0
"""ROS 2 parameter files, read, checked and written without ROS."""

from collections.abc import Callable, Iterator, Mapping
import difflib
from pathlib import Path
import re
from typing import Any, TypeVar

from fhaosmo_ros.core.parameters.declaration import (
    Parameters,
    ParameterTable,
    shown,
    unknown_parameter,
)
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import (
    channel_names,
    CHANNELS,
    of_named_channel,
    UNNAMED,
    with_channels,
    with_own_parameters,
)
from fhaosmo_ros.core.parameters.tables import CHANNEL_PARAMETERS, NODE_TABLES
from fhaosmo_ros.core.parameters.yaml_text import MAX_LENGTH, parse
import yaml

Made = TypeVar('Made')

BUILT_IN = ('use_sim_time', 'start_type_description_service')
"""Parameters that rclpy declares itself."""
DUMPER = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
"""libyaml's dumper is about ten times as fast: a node writes its parameters between samples."""


def is_built_in(name: str) -> bool:
    """Return True for a parameter that is rclpy's, not ours."""
    return name in BUILT_IN or name.startswith('qos_overrides.')


def load(
    path: str | Path, node: str, table: ParameterTable | None = None, strict: bool = False
) -> dict[str, Any]:
    """
    Return what a parameter file sets for a node of this package.

    Sections that match the node's name are merged in the order of the file, as rcl does. One
    ``/**`` section may serve both nodes, so names that only another node of the package declares
    are ignored.

    Parameters
    ----------
    path : path
        A YAML file of the form ``name: {ros__parameters: {...}}``.
    node : str
        'estimator' or 'plant', or a full name such as '/rig/estimator'.
    table : ParameterTable, optional
        What the node declares; without it, that of the last part of its name.
    strict : bool
        Raise if no section is the node's. ROS ignores such a file; here it is ignored unless a
        section's name looks like a misspelt one of the node.

    Returns
    -------
    dict
        Values by name, checked and in the parameters' own types.

    Raises
    ------
    ConfigurationError
        No such file, not YAML, no ``ros__parameters``, a misspelt section, an unknown name or a
        bad value; the message begins with the path.

    """
    values = read(path, node, strict)
    try:
        return select(values, table or NODE_TABLES[node.rsplit('/', 1)[-1]])
    except ConfigurationError as error:
        raise ConfigurationError(f'{path}: {error}') from None


def loads(text: str, node: str, table: ParameterTable) -> dict[str, Any]:
    """Return what the text of a parameter file sets for a node; see `load`."""
    return select(_of_node(text, node, strict=True), table)


def dumps(values: Mapping[str, Any], node: str = '/**') -> str:
    """Return the text of a file that sets values of Python's own types for nodes of that name."""
    # Copies of the lists: PyYAML writes an alias where one list comes twice, and ROS reads none.
    copied = {name: list(v) if isinstance(v, list) else v for name, v in values.items()}
    content = {node: {'ros__parameters': copied}}
    text = yaml.dump(content, Dumper=DUMPER, sort_keys=False, default_flow_style=None, width=99)
    return str(text)


def read(path: str | Path, node: str, strict: bool = False) -> dict[str, Any]:
    """Return what a file sets for a node; names and values are not checked yet; see `load`."""
    try:
        with Path(path).open(encoding='utf-8') as file:
            text = file.read(MAX_LENGTH + 1)
        return _of_node(text, node, strict)
    except OSError as error:
        problem = f'expected a readable file, got: {error.strerror}'
    except UnicodeDecodeError as error:
        problem = f'expected YAML, got: {error}'
    except ConfigurationError as error:
        problem = str(error)
    raise ConfigurationError(f'{path}: {problem}')


def _of_node(text: str, node: str, strict: bool) -> dict[str, Any]:
    """Return the parameters in the sections of a text that are a node's."""
    content = parse(text)
    sections: dict[str, dict[str, Any]] = {}
    if isinstance(content, Mapping):
        _collect(content, '', sections)
    if not sections:
        raise ConfigurationError(
            "expected 'NODE: {ros__parameters: {...}}' (NODE is a node's name or /**), "
            f'got {shown(content)}'
        )
    ours = [section for section in sections if _matches(section, node)]
    names = [section.lstrip('/') for section in sections]
    if not ours and (strict or any(_misspells(name, node) for name in names)):
        raise ConfigurationError(f"expected a section '{node}' or '/**', got {', '.join(names)}")
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
    estimator = with_channels(with_own_parameters(names, values))
    if CHANNELS in table:
        table = estimator
    tables = [table, estimator, *NODE_TABLES.values()]
    for name in values:
        if not any(name in other for other in tables) and not is_built_in(name):
            raise unknown_parameter(name, dict.fromkeys(n for other in tables for n in other))
    return {
        name: names if name == CHANNELS else table[name].coerce(value)
        for name, value in values.items()
        if name in table
    }


def complete(values: Mapping[str, Any], table: ParameterTable) -> Parameters:
    """
    Check what files and the command line set for a node, each value once; see `select`.

    The channels' own parameters are among the result; they default to the common values.
    """
    checked = select(values, table)
    channels = with_own_parameters(checked.get(CHANNELS, UNNAMED), checked)
    common = table.defaults() | checked
    own = {
        f'{channel}.{name}': value
        for channel in filter(None, channels)
        for name, value in common.items()
        if name in CHANNEL_PARAMETERS
    }
    return Parameters(with_channels(channels) if own else table, own | checked)


def make_from_file(
    make: Callable[[Parameters], Made], path: str | Path, node: str, channel: str
) -> Made:
    """
    Return what `make` makes of the parameters that a file sets for a channel of an estimator.

    The channel of a node that has a single one is called ''.

    Raises
    ------
    ConfigurationError
        As `load` and `make`, no section of the node, or a channel that it does not have.

    """
    table = NODE_TABLES['estimator']
    values = load(path, node, table, strict=True)
    try:
        own = of_named_channel(values, channel, 'channel')
        return make(Parameters(table, table.part_of(own)))
    except ConfigurationError as error:
        raise ConfigurationError(f'{path}: {error}') from None


def with_origin(
    error: ConfigurationError, origins: Mapping[str, object], channel: str = ''
) -> ConfigurationError:
    """
    Return the error with the file in front that has set the parameter which it names.

    Parameters
    ----------
    error : ConfigurationError
    origins : mapping
        File (or another source) of each value by name; None for the command line.
    channel : str
        The channel that the error is about, where its text does not say it.

    """
    found = re.match(r"(?:channel '([^']+)': )?(?:unknown )?parameter '([^']+)'", str(error))
    if not found:
        return error
    name = found[2]
    origin = origins.get(f'{found[1] or channel}.{name}', origins.get(name))
    return ConfigurationError(f'{origin}: {error}') if origin else error


def _collect(content: Mapping[Any, Any], name: str, out: dict[str, dict[str, Any]]) -> None:
    """Add the sections below `name`, and their parameters by their dotted names."""
    section = name.replace('//', '/')
    for key, value in content.items():
        if not isinstance(value, Mapping):
            place = f"parameters below ros__parameters of section '{section}'"
            if key != 'ros__parameters':
                place = f"ros__parameters below '{section or key}'"
            raise ConfigurationError(f'expected {place}, got {shown(key)}: {shown(value)}')
        if key != 'ros__parameters':
            _collect(value, f'{name}/{key}', out)
            continue
        parameters = out.setdefault(name, {})
        for parameter, setting in _flat(value):
            if parameter in parameters:
                raise ConfigurationError(f"section '{section}': '{parameter}' is set twice")
            parameters[parameter] = setting


def _flat(values: Mapping[Any, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield parameters by their dotted names: ``hip: {lambda: 3}`` is ``hip.lambda``."""
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
            f'got {kinds} mixed: {shown(value)}'
        )


def _misspells(section: str, node: str) -> bool:
    """Return True if a section's last part is nearly the node's; numbers make other nodes."""
    theirs, ours = section.rsplit('/', 1)[-1], node.rsplit('/', 1)[-1]
    if re.sub(r'\d+', '', theirs) == re.sub(r'\d+', '', ours):
        return False
    return bool(difflib.get_close_matches(ours.lower(), [theirs.lower()], cutoff=0.8))


def _matches(section: str, node: str) -> bool:
    """Return True if a section's name covers a node: * is one name, ** any number of them."""
    pattern = '/' + '/'.join(part for part in section.split('/') if part)
    expression = re.escape(pattern).replace(r'/\*\*', '(/[^/]+)*').replace(r'\*', '[^/]+')
    return re.fullmatch(expression, '/' + node.lstrip('/')) is not None
