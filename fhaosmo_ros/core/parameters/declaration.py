# SPDX-License-Identifier: Apache-2.0
"""What a parameter is: declared once, checked everywhere by the same rules."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
import difflib
import math
import re
from typing import Any, TypeAlias

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.removed import REMOVED
from fhaosmo_ros.core.parameters.yaml_text import parse
import numpy as np

Value: TypeAlias = bool | int | float | str | list[float] | list[str]

KINDS = {
    'bool': 'true or false', 'int': 'an integer', 'double': 'a number', 'string': 'a string',
    'double_array': 'a list of numbers', 'string_array': 'a list of strings',
}  # fmt: skip
TYPES: dict[str, Any] = {'bool': bool, 'int': int, 'double': float, 'string': str}
ANY_NAME = '.NAME'
"""
End of the name of a declaration that stands for any number of parameters that users name, each a
letter, then letters, digits and _.
"""


@dataclass(frozen=True)
class Parameter:
    """One parameter: the only place where its name, default, unit, bounds and text stand."""

    name: str  # in YAML, on the command line and in ROS; see `ANY_NAME`
    default: Value  # its type is the parameter's type
    text: str  # what it does, one or two sentences
    unit: str = ''  # SI, empty where there is none
    lower: float = -math.inf  # with `upper` the allowed interval, of each number of a list
    upper: float = math.inf
    lower_open: bool = False  # `lower` itself is not allowed
    choices: tuple[str, ...] = ()  # allowed values of a string
    live: bool = True  # it can change in a running node
    lengths: str = ''  # allowed numbers of values of a list, in words, for the documentation

    @property
    def kind(self) -> str:
        """One of the keys of `KINDS`."""
        is_list = isinstance(self.default, list)
        item = self.default[0] if isinstance(self.default, list) else self.default
        return next(kind for kind in TYPES if TYPES[kind] is type(item)) + '_array' * is_list

    @property
    def allowed(self) -> str:
        """Allowed values, in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        text = KINDS[self.kind]
        if self.upper < math.inf:
            text += f' {">" if self.lower_open else ">="} {self.lower:g} and <= {self.upper:g}'
        return text + (f' [{self.unit}]' if self.unit else '')

    def coerce(self, value: Any) -> Value:
        """
        Return `value` in the parameter's own type, or raise ConfigurationError.

        An integer is accepted where a number is meant, one number for a list, and the text of a
        number or a list: `ros2 param set` sends 1e-3 and ``[15, 15.5]`` as texts.
        """
        given, kind = value, self.kind
        is_list = kind.endswith('_array')
        if isinstance(value, str) and (is_list or kind == 'double'):
            try:
                value = parse(value)
            except ConfigurationError:
                raise self.error(given) from None
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        if not is_list or isinstance(value, str if kind == 'string_array' else int | float):
            value = [value]
        elif isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
            raise self.error(given)  # rclpy delivers array.array, so any other iterable will do
        items = [self._item(item) for item in value]
        if not items or None in items:
            raise self.error(given)
        return items if is_list else items[0]

    def _item(self, item: Any) -> Any:
        """Return a value, or an item of a list, in its type; None where it is not allowed."""
        wanted = TYPES[self.kind.removesuffix('_array')]
        is_number = isinstance(item, int | float) and not isinstance(item, bool)
        if self.kind == 'string_array' and is_number:
            item = repr(item)  # 0 in `phi: [0, 0, -z3]` is a number to YAML, not to its writer
        elif wanted is float and is_number:
            with suppress(OverflowError):
                item = float(item)
        if not isinstance(item, wanted) or isinstance(item, bool) != (wanted is bool):
            return None
        if isinstance(item, bool | str):
            return item if not self.choices or item in self.choices else None
        within = self.lower < item <= self.upper or (item == self.lower and not self.lower_open)
        return item if within and abs(item) != math.inf else None

    def error(self, value: Any, allowed: str | None = None) -> ConfigurationError:
        """Build the error for `value`: what was wrong, what is allowed, what arrived."""
        expected = allowed or self.allowed
        message = f"parameter '{self.name}': expected {expected}, got {shown(value)}"
        if self.choices and isinstance(value, str):
            message += suggestion(value, self.choices)
        return ConfigurationError(message)


class ParameterTable(Mapping[str, Parameter]):
    """
    Parameters by name, in the order in which they are declared.

    `declared` has declarations of parameters that users name, too; iteration leaves them out.
    """

    def __init__(self, *groups: Iterable[Parameter]) -> None:
        self._by_name = {p.name: p for group in groups for p in group}
        self.declared = tuple(self._by_name.values())

    def __getitem__(self, name: str) -> Parameter:
        if name in self._by_name or '.' not in name:
            return self._by_name[name]
        family = re.sub(r'\.[A-Za-z][A-Za-z0-9_]*$', ANY_NAME, name)
        return replace(self._by_name[family], name=name)

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._by_name if not name.endswith(ANY_NAME))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def part_of(self, values: 'Mapping[str, Any]') -> dict[str, Any]:
        """Return those of `values` that this table declares, in its order."""
        names = [*self, *values]
        return {name: values[name] for name in names if name in values and name in self}

    def defaults(self) -> dict[str, Any]:
        """Return a fresh dictionary of the defaults."""
        return {p.name: copy(p.default) for p in self.values()}

    def complete(
        self, values: 'Mapping[str, Any] | None' = None, named: 'Mapping[str, Any] | None' = None
    ) -> 'Parameters':
        """
        Return the values of all parameters: those given, checked, and defaults for the rest.

        `named` are keyword arguments, which win; lambda_ stands for lambda. `Parameters` of any
        table have been checked already and are not checked again: of a larger table the part that
        this one declares is taken. Raises as `coerce`.
        """
        if isinstance(values, Parameters) and not named:
            return values if values.table is self else Parameters(self, self.part_of(values))
        named = {name.removesuffix('_'): value for name, value in (named or {}).items()}
        return Parameters(self, self.coerce(values or {}) | self.coerce(named))

    def coerce(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """
        Check names, types and bounds of `values`; what is absent stays absent.

        ``{'constants': {'k': 3}}`` is the same as ``{'constants.k': 3}``. Raises
        ConfigurationError for an unknown name (with the closest known one), or a bad value.
        """
        if not isinstance(values, Mapping):
            raise ConfigurationError(
                'parameters: expected a mapping of names to values (`from_yaml` reads a file), '
                f'got {shown(values)}'
            )
        flat: dict[str, Any] = {}
        for name, value in values.items():
            if f'{name}{ANY_NAME}' in self._by_name and isinstance(value, Mapping):
                flat |= {f'{name}.{key}': number for key, number in value.items()}
            else:
                flat[name] = value
        for name in flat:
            if name not in self:
                raise unknown_parameter(name, self._by_name)
        return {name: self[name].coerce(value) for name, value in flat.items()}


class Parameters(dict[str, Any]):
    """
    Values of all parameters of a `table`, checked once and each in its own type.

    `ParameterTable.complete` makes them where values enter the package. Code that receives them
    neither checks nor changes them.
    """

    def __init__(self, table: ParameterTable, checked: dict[str, Any]) -> None:
        super().__init__(table.defaults() | checked)
        self.table = table

    def changed(self, changes: Mapping[str, Any]) -> 'Parameters':
        """Return these values with some changed, which are checked as by `coerce`."""
        if isinstance(changes, Parameters):
            return self.table.complete(changes)
        return Parameters(self.table, self | self.table.coerce(changes))

    def changed_live(self, changes: Mapping[str, Any], running: str) -> 'Parameters':
        """
        Return these values with some changed while something that was made of them runs.

        Raises as `changed`, or for another value of a parameter that can't change live; the
        message says what is `running`, such as 'observer'.
        """
        parameters = self.changed(changes)
        for name, value in parameters.items():
            if name not in self:
                raise unknown_parameter(name, self)
            if not self.table[name].live and value != self[name]:
                raise ConfigurationError(
                    f"parameter '{name}': can't change in a running {running} (it is "
                    f'{self[name]!r}), got {value!r}'
                )
        return parameters


def unknown_parameter(name: str, known: Iterable[str]) -> ConfigurationError:
    """Build the error for a name that nobody declared, or that is declared no more."""
    successor = REMOVED.get(name.rpartition('.')[2])
    if successor:
        return ConfigurationError(f"parameter '{name}' is gone: {successor}")
    known = list(known)
    hint = suggestion(name, known) or '; known are ' + ', '.join(known)
    return ConfigurationError(f"unknown parameter '{name}'{hint}")


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return ``; did you mean 'x'?`` for the closest of `known`, or nothing."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean '{close[0]}'?" if close else ''


def shown(value: Any) -> str:
    """Return a value as a message shows it: at most 120 characters."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    elif isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        value = list(value)
    try:
        text = repr(value)
    except ValueError:  # Python prints at most 4,300 digits
        text = 'a longer integer'
    return text if len(text) <= 120 else text[:117] + '...'
