# SPDX-License-Identifier: Apache-2.0
"""ROS 2 parameter files, read, checked and written without ROS."""

from collections.abc import Callable, Iterator, Mapping
import difflib
from pathlib import Path
import re
from typing import Any, TypeVar

from fhaosmo_ros.core.parameters.declaration import Parameters, ParameterTable, shown
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import of_named_channel, select
from fhaosmo_ros.core.parameters.tables import NODE_TABLES
from fhaosmo_ros.core.parameters.yaml_text import MAX_LENGTH, parse
import yaml

Made = TypeVar('Made')

MARK = 'ros__parameters'
"""Key between the name of a node and its parameters."""
DUMPER = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
"""libyaml's dumper is about ten times as fast: a node writes its parameters between samples."""


def load(
    path: str | Path, node: str, table: ParameterTable | None = None, strict: bool = False
) -> dict[str, Any]:
    """
    Return what a parameter file sets for a node of this package, by name, checked and typed.

    `node` is 'estimator', 'plant' or 'arm', or a full name such as '/rig/estimator'; `table` is
    what it declares, if not that of the last part of its name. Sections that match the node's name
    are merged in the order of the file, as rcl does. One ``/**`` section may serve several nodes,
    so names that only another node of the package declares are ignored. A file without a section
    for the node is ignored, as by ROS, unless a name looks like a misspelt one, or if `strict`.

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
    content = {node: {MARK: copied}}
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


def make_from_file(
    make: Callable[[Parameters], Made], path: str | Path, node: str, channel: str
) -> Made:
    """
    Return what `make` makes of the parameters that a file sets for a channel of an estimator.

    '' stands for the channel of a node that has a single one. Raises ConfigurationError as `load`
    and `make`, for a file without a section of the node, or without the channel.
    """
    values = load(path, node, NODE_TABLES['estimator'], strict=True)
    try:
        return make(of_named_channel(values, channel, 'channel')[1])
    except ConfigurationError as error:
        raise ConfigurationError(f'{path}: {error}') from None


def with_origin(
    error: ConfigurationError, origins: Mapping[str, object], channel: str = ''
) -> ConfigurationError:
    """
    Return the error with the file in front that has set the parameter which it names.

    `origins` has the file, or another source, of each value by name, None for the command line;
    `channel` is what the error is about, where its text does not say it.
    """
    found = re.match(r"(?:channel '([^']+)': )?(?:unknown )?parameter '([^']+)'", str(error))
    if not found:
        return error
    origin = origins.get(f'{found[1] or channel}.{found[2]}', origins.get(found[2]))
    return ConfigurationError(f'{origin}: {error}') if origin else error


def _of_node(text: str, node: str, strict: bool) -> dict[str, Any]:
    """Return the parameters in the sections of a text that are a node's."""
    sections: dict[str, dict[str, Any]] = {}
    for keys, value in _leaves(parse(text)):
        if MARK not in keys or (keys[-1] == MARK and value != {}):
            place = f'{shown("/".join(keys).replace("//", "/"))}: ' if keys else ''
            raise ConfigurationError(
                f"expected 'NODE: {{{MARK}: {{...}}}}' (NODE is a node's name or /**), "
                f'got {place}{shown(value)}'
            )
        mark = keys.index(MARK)
        section, name = '/'.join(keys[:mark]), '.'.join(keys[mark + 1 :])
        parameters = sections.setdefault(section, {})
        if name in parameters:
            raise ConfigurationError(f"section '{section}': '{name}' is set twice")
        if value != {}:
            parameters[name] = value
    if not any(_matches(section, node) for section in sections) and (
        strict or any(_misspells(section, node) for section in sections)
    ):
        raise ConfigurationError(
            f"expected a section '{node}' or '/**', got {', '.join(sections)}"
        )
    ours = [values for section, values in sections.items() if _matches(section, node)]
    return {name: value for values in ours for name, value in values.items()}


def _leaves(content: Any, keys: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield what is no mapping, or an empty one, with the keys on the way to it."""
    if not isinstance(content, Mapping) or not content:
        yield keys, content
        return
    for key, value in content.items():
        yield from _leaves(value, (*keys, str(key)))


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
