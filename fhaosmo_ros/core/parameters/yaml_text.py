# SPDX-License-Identifier: Apache-2.0
"""
YAML as ROS 2 reads it: any text gives its content, or one `ConfigurationError`.

PyYAML's own constructors raise `ValueError`, `KeyError`, `AttributeError` and `RecursionError` for
some texts (`2020-99-99`, ``!!bool x``, a thousand brackets). So the content is made here from the
parser's events, which come one at a time: a text that is too large is refused in the middle.
"""

import re
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import yaml
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

PARSER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
"""libyaml, which rcl uses too, where PyYAML has it; else the parser in Python."""
MAX_LENGTH = 1_000_000
"""Characters of a text."""
MAX_VALUES = 50_000
"""Keys, values, lists and mappings of a text."""
MAX_DEPTH = 30
"""Lists and mappings within each other."""
MAX_DIGITS = 400
"""Characters of an integer: the largest double has 309 digits, and Python prints at most 4,300."""

TAG = 'tag:yaml.org,2002:'
SCALARS = {TAG + name for name in ('null', 'bool', 'int', 'float', 'str')}


class _Scalars(SafeConstructor, Resolver):
    """
    PyYAML's rules for scalars, changed to those of rcl.

    A date is a text, and 1e-3 is a number, which YAML 1.1 takes for a text.
    """

    def __init__(self) -> None:
        SafeConstructor.__init__(self)
        Resolver.__init__(self)

    def value(self, event: Any) -> Any:
        """Return what a scalar stands for."""
        tag, text = event.tag, event.value
        if tag in (None, '!'):
            tag = self.resolve(yaml.ScalarNode, text, event.implicit)  # type: ignore[no-untyped-call]
        if tag not in SCALARS:
            raise _refused(event, f'the tag {tag!r}')
        if tag == TAG + 'int' and len(text) > MAX_DIGITS:
            raise _refused(event, f'an integer of more than {MAX_DIGITS} digits')
        try:
            return self.yaml_constructors[tag](self, yaml.ScalarNode(tag, text))
        except (ArithmeticError, LookupError, ValueError):
            kind = tag.removeprefix(TAG)
            raise _refused(event, f'{text[:40]!r}, which is no {kind}') from None


_Scalars.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in rules if tag in SCALARS]
    for first, rules in Resolver.yaml_implicit_resolvers.items()
}
_Scalars.add_implicit_resolver(
    TAG + 'float',
    re.compile(r'[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$'),
    list('-+.0123456789'),
)


class _Content:
    """Makes the content of a text from the parser's events, within the bounds above."""

    def __init__(self, text: str) -> None:
        self.events = yaml.parse(text, Loader=PARSER)
        self.scalars = _Scalars()
        self.values = 0

    def document(self) -> Any:
        """Return the content of the only document, None if there is none."""
        next(self.events)  # the stream's start
        if isinstance(next(self.events), yaml.StreamEndEvent):
            return None
        content = self.value(next(self.events), 0)
        next(self.events)  # the document's end
        event = next(self.events)
        if not isinstance(event, yaml.StreamEndEvent):
            raise _refused(event, 'a second document')
        return content

    def value(self, event: Any, depth: int) -> Any:
        """Return a scalar, a list or a mapping that begins with this event."""
        self.values += 1
        if self.values > MAX_VALUES:
            raise _refused(event, f'more than {MAX_VALUES} values')
        if depth > MAX_DEPTH:
            raise _refused(event, f'lists or mappings nested deeper than {MAX_DEPTH}')
        if isinstance(event, yaml.ScalarEvent):
            return self.scalars.value(event)
        if isinstance(event, yaml.AliasEvent):
            raise _refused(event, f'the alias *{event.anchor}, which ROS does not read either')
        if event.tag not in (None, '!', TAG + 'seq', TAG + 'map'):
            raise _refused(event, f'the tag {event.tag!r}')
        if isinstance(event, yaml.SequenceStartEvent):
            return self.items(depth + 1)
        return self.mapping(depth + 1)

    def items(self, depth: int) -> list[Any]:
        """Return the items of a list up to its end."""
        items = []
        while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
            items.append(self.value(event, depth))
        return items

    def mapping(self, depth: int) -> dict[Any, Any]:
        """Return the keys and values of a mapping up to its end."""
        content = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                raise _refused(event, 'a key that is no plain text')
            key = self.value(event, depth)
            if key in content:
                raise _refused(event, f'the key {event.value[:40]!r} twice')
            content[key] = self.value(next(self.events), depth)
        return content


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
        return _Content(text).document()
    except yaml.YAMLError as error:
        problem = ' '.join(str(error).split())[:300]
    except UnicodeEncodeError:
        problem = 'a surrogate, which is no character'
    problem = ''.join(c if c.isprintable() else '?' for c in problem)
    raise ConfigurationError(f'expected YAML, got: {problem}')


def _refused(event: Any, problem: str) -> ConfigurationError:
    line = event.start_mark.line + 1
    return ConfigurationError(f'expected YAML, got: {problem[:200]} (line {line})')
