# SPDX-License-Identifier: Apache-2.0
"""YAML as ROS 2 reads it: any text gives its content, or one `ConfigurationError`."""

import re
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import yaml

PARSER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
"""libyaml, which rcl uses too, where PyYAML has it; else the parser in Python."""
MAX_LENGTH = 1_000_000
"""Characters of a text."""
MAX_VALUES = 50_000
"""Keys, values, lists and mappings of a text."""
MAX_DEPTH = 30
"""Lists and mappings within each other."""
MAX_BITS = 1024
"""Of an integer: no double is larger."""

TAG = 'tag:yaml.org,2002:'
SCALARS = {TAG + name for name in ('null', 'bool', 'int', 'float', 'str')}
TAGS: dict[type[yaml.Event], set[str]] = {
    yaml.SequenceStartEvent: {TAG + 'seq'},
    yaml.MappingStartEvent: {TAG + 'map'},
}
"""Of what begins with such an event; all else is a scalar."""


class _Loader(PARSER):  # type: ignore[misc, valid-type]
    """
    PyYAML's rules, changed to those of rcl.

    A date is a text, and 1e-3 is a number, which YAML 1.1 takes for a text. No key comes twice.
    """

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return the keys and values of a mapping."""
        content: dict[Any, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise _refused(key_node, 'a key that is no plain text')
            key = self.construct_object(key_node)
            if key in content:
                raise _refused(key_node, f'the key {key_node.value[:40]!r} twice')
            content[key] = self.construct_object(value_node, deep=deep)
        return content

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """Return what a scalar, a list or a mapping stands for."""
        try:
            value = super().construct_object(node, deep=deep)
        except (ArithmeticError, LookupError, ValueError) as error:
            if isinstance(error, ConfigurationError):
                raise
            kind = node.tag.removeprefix(TAG)
            raise _refused(node, f'{node.value[:40]!r}, which is no {kind}') from None
        if isinstance(value, int) and value.bit_length() > MAX_BITS:
            raise _refused(node, f'an integer of more than {MAX_BITS} bits')
        return value


_Loader.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in rules if tag in SCALARS]
    for first, rules in PARSER.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    TAG + 'float',
    re.compile(r'[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$'),
    list('-+.0123456789'),
)


def parse(text: str) -> Any:
    """
    Return the content of a YAML text.

    Raises
    ------
    ConfigurationError
        The text is not YAML or too large, has a key twice in one mapping, or has what ROS does
        not read: aliases, keys that are not scalars, tags other than those of plain scalars.

    """
    if len(text) > MAX_LENGTH:
        raise ConfigurationError(
            f'expected YAML, got: {len(text)} characters, at most {MAX_LENGTH} are read'
        )
    try:
        _check(text)
        return yaml.load(text, Loader=_Loader)  # noqa: S506, a safe loader
    except yaml.YAMLError as error:
        problem = ' '.join(str(error).split())[:300]
    except UnicodeEncodeError:
        problem = 'a surrogate, which is no character'
    problem = ''.join(c if c.isprintable() else '?' for c in problem)
    raise ConfigurationError(f'expected YAML, got: {problem}')


def parse_rule(rule: str) -> tuple[str, Any]:
    """Return name and value of a command line's rule NAME:=VALUE; raise as `parse`."""
    name, separator, text = rule.partition(':=')
    if not (separator and name):
        raise ConfigurationError(f'-p: expected NAME:=VALUE, got {rule!r}')
    try:
        return name, parse(text)
    except ConfigurationError as error:
        raise ConfigurationError(f"parameter '{name}': {error}") from None


def _check(text: str) -> None:
    """Refuse what is too large, or not read by ROS, before anything is made of it."""
    values = depth = 0
    for event in yaml.parse(text, Loader=PARSER):
        values += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if values > MAX_VALUES:
            raise _refused(event, f'more than {MAX_VALUES} values')
        if depth > MAX_DEPTH:
            raise _refused(event, f'lists or mappings nested deeper than {MAX_DEPTH}')
        if isinstance(event, yaml.AliasEvent):
            raise _refused(event, f'the alias *{event.anchor}, which ROS does not read either')
        tag = getattr(event, 'tag', None)
        if tag not in {None, '!'} | TAGS.get(type(event), SCALARS):
            raise _refused(event, f'the tag {tag!r}')


def _refused(place: Any, problem: str) -> ConfigurationError:
    line = place.start_mark.line + 1
    return ConfigurationError(f'expected YAML, got: {problem[:200]} (line {line})')
