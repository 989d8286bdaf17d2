# SPDX-License-Identifier: Apache-2.0
"""
Which number of a message of any type is meant, by the definitions of the types.

Definitions are those of a rosbags typestore (``fielddefs``): by type, its constants and its fields
as pairs of a name and (kind, detail). Nodes make the same of message classes.
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from math import asin, atan2, copysign, pi
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""How rosbags numbers the kinds of a field."""
HEADER = 'std_msgs/msg/Header'
QUATERNION = 'geometry_msgs/msg/Quaternion'
JOINT_STATE = 'sensor_msgs/msg/JointState'
ANGLES = ('roll', 'pitch', 'yaw')
"""Of a quaternion, as if they were fields of it: rotations about x, y, z (fixed axes)."""
KINDS = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1', 'int8': 'i1', 'uint8': 'u1',
    'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8',
    'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
MOST_LISTED, LONGEST_LISTED = 10, 60
"""Names that one line lists, and letters of each: a message may have thousands."""
IDENTIFIER = r'[A-Za-z]\w*'
SUBSCRIPT = r'\[[^\[\]]+\]'


class Key(NamedTuple):
    """An element of a list by its name, which stands in another list of the same message."""

    name: str
    names: str
    """Field with the names, beside the list."""


class Field(NamedTuple):
    """
    A number in the messages of a topic.

    Attributes
    ----------
    text : str
        As the user wrote it, such as 'angular_velocity.z', 'position[2]' or 'position[elbow]'.
    steps : list of str, int and Key
        Names of fields and elements of lists, from the message inwards.
    kind : dtype
    has_header : bool
        True if the message begins with a std_msgs/Header.
    types : mapping
        Definitions by type.
    message_type : str
    angle : str
        One of `ANGLES` where the steps lead to the x of a quaternion, else ''.

    """

    text: str
    steps: list[str | int | Key]
    kind: np.dtype
    has_header: bool
    types: Mapping[str, Any]
    message_type: str
    angle: str = ''

    @property
    def width(self) -> int:
        """How many numbers one value is made of: 4 for the angle of a quaternion."""
        return 4 if self.angle else 1

    @property
    def wraps(self) -> bool:
        """True for an angle that jumps by a whole turn, unless an `Unwrapper` follows it."""
        return self.angle in ('roll', 'yaw')

    @property
    def key(self) -> str:
        """Name of the element of a list that is meant, '' if it is not meant by name."""
        return next((s.name for s in reversed(self.steps) if isinstance(s, Key)), '')

    def value(self, message: Any) -> float:
        """
        Return the number in a message object, of rclpy or of rosbags.

        Raises
        ------
        MissingElementError
            A list of the message is too short, or lacks the name.

        """
        around, node = message, message
        for step in self.steps:
            if isinstance(step, str):
                around, node = node, getattr(node, step)
                continue
            index = step if isinstance(step, int) else self._index(step, around)
            if index >= len(node):
                problem = (
                    'expected an index below the number of elements, '
                    f'{len(node)} in one message, got {index}'
                )
                if isinstance(step, Key):  # the same text wherever the name stands
                    problem = f'expected an element for each name, got none for {step.name!r}'
                raise MissingElementError(f'field {self.text!r}: {problem}')
            node = node[index]
        if self.angle:
            return angle_of(self.angle, around.x, around.y, around.z, around.w)
        return float(node)

    def _index(self, key: Key, around: Any) -> int:
        names = getattr(around, key.names)
        if key.name not in names:
            raise MissingElementError(
                f'field {self.text!r}: expected a name that is in the message '
                f'({listed(names) or "which has none"}), got {key.name!r}'
                f'{suggestion(key.name, islice(names, MOST_LISTED))}'
            )
        return int(names.index(key.name))

    def stamp(self, message: Any) -> int:
        """Return the stamp of the header that the message begins with, in nanoseconds."""
        stamp = getattr(message, self.types[self.message_type][1][0][0]).stamp
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


class MissingElementError(ConfigurationError):
    """One message does not have the element of a list that is meant; others may."""


def listed(names: Iterable[str]) -> str:
    """Return names separated by commas, as far as one line has room for them."""
    texts = [n if len(n) <= LONGEST_LISTED else f'{n[:LONGEST_LISTED]}...' for n in names]
    more = len(texts) - MOST_LISTED
    return ', '.join(texts[:MOST_LISTED]) + (f' and {more} more' if more > 0 else '')


def find_field(
    types: Mapping[str, Any], message_type: str, text: str | None, name: str = ''
) -> Field:
    """
    Find a field in a message type; without a text, take the type's only number or its `data`.

    Parameters
    ----------
    types : mapping
        Definitions by type.
    message_type : str
        Such as 'sensor_msgs/msg/JointState'.
    text : str or None
        Names separated by dots. [index] or [name of the element] follows the name of a list;
        names are those in the list of strings beside it. roll, pitch and yaw of a quaternion.
    name : str
        Which element is meant where the text ends with a list; such a text may be left out for a
        JointState, whose ``position`` it is then.

    Raises
    ------
    ConfigurationError
        There is no such field, or it holds no number; the message lists the fields that do.

    """
    if not text:
        text = 'position' if name and message_type == JOINT_STATE else None
    if text is None:
        text = _only_number(types, message_type)
    found = _follow(types, message_type, text, name)
    if found is None:
        known = list(_numbers(types, message_type))
        hint = suggestion(text, known)
        raise ConfigurationError(
            f'field {text!r}: expected a number in {message_type}, one of '
            f'{", ".join(known) or "none: it holds no number"}, got {text!r}{hint}'
        )
    steps, kind, angle = found
    fields = types[message_type][1]
    has_header = bool(fields) and tuple(fields[0][1]) == (NAME, HEADER)
    return Field(text, steps, np.dtype(kind), has_header, types, message_type, angle)


def _only_number(types: Mapping[str, Any], message_type: str) -> str:
    known = list(_numbers(types, message_type))
    if len(known) == 1 and '[' not in known[0]:
        return known[0]
    if 'data' in known:
        return 'data'
    raise ConfigurationError(
        f'a field (input_field, --field) is needed for {message_type}: expected one of '
        f'{", ".join(known) or "none: it holds no number"}, got nothing'
    )


def _numbers(types: Mapping[str, Any], message_type: str, prefix: str = '') -> Iterator[str]:
    """Yield the paths of all numbers of a type, lists with [i]."""
    for name, (node, detail) in types[message_type][1]:
        path = prefix + name
        if node in (ARRAY, SEQUENCE):
            node, detail = detail[0]
            path += '[i]'
        if node == NAME:
            if detail != HEADER:
                yield from _numbers(types, detail, f'{path}.')
            if detail == QUATERNION:
                yield from (f'{path}.{angle}' for angle in ANGLES)
        elif detail[0] in KINDS:
            yield path


def _follow(
    types: Mapping[str, Any], message_type: str, text: str, name: str
) -> tuple[list[str | int | Key], str, str] | None:
    """Return the steps to a number, its kind and the angle; None if they lead to none."""
    part = f'{IDENTIFIER}({SUBSCRIPT})*'
    if not re.fullmatch(rf'{part}(\.{part})*', text):
        return None
    words = re.findall(rf'(?:^|\.)({IDENTIFIER})|\[([^\[\]]+)\]', text)
    steps: list[str | int | Key] = []
    node: Any = (NAME, message_type)
    beside: list[Any] = []  # the fields among which the present one stands
    for k, (word, subscript) in enumerate(words):
        if word and node[0] == NAME and node[1] in types:
            if node[1] == QUATERNION and word in ANGLES and k == len(words) - 1:
                return [*steps, 'x'], KINDS['float64'], word
            beside = types[node[1]][1]
            node = dict(beside).get(word, (None, None))
            steps.append(word)
        elif subscript and node[0] in (ARRAY, SEQUENCE):
            step = _element(subscript, node, beside)
            if step is None:
                return None
            steps.append(step)
            node = node[1][0]
        else:
            return None
    if node[0] in (ARRAY, SEQUENCE) and name:
        step = _element(name, node, beside, by_name=True)
        if step is None:
            return None
        steps.append(step)
        node = node[1][0]
    kind = KINDS.get(node[1][0]) if node[0] == BASE else None
    return None if kind is None else (steps, kind, '')


def _element(text: str, node: Any, beside: list[Any], by_name: bool = False) -> int | Key | None:
    if text.isdigit() and not by_name:
        inside = node[0] == SEQUENCE or int(text) < node[1][1]
        return int(text) if inside else None
    names = [
        name
        for name, (kind, detail) in beside
        if kind in (ARRAY, SEQUENCE)
        and detail[0][0] == BASE
        and detail[0][1][0] == 'string'
        and (name in ('name', 'names') or name.endswith('_names'))
    ]
    return Key(text, names[0]) if names else None


def angle_of(angle: str, x: float, y: float, z: float, w: float) -> float:
    """Return roll, pitch or yaw of a quaternion of any length, in rad (NaN of a zero one)."""
    n = x * x + y * y + z * z + w * w
    if not n > 0.0:
        return float('nan')
    if angle == 'roll':
        return atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    if angle == 'yaw':
        return atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    sine = 2.0 * (w * y - z * x) / n
    return asin(sine) if abs(sine) < 1.0 else copysign(0.5 * pi, sine)


class Unwrapper:
    """
    Makes an angle continuous: adds the whole turns that bring it nearest to the one before.

    Values that are not finite pass through. Nodes and tools add the same turns to the same
    numbers, so their results are equal to the last bit.
    """

    def __init__(self) -> None:
        self._turns = 0
        self._before: float | None = None

    def begin_near(self, value: float) -> None:
        """Count from `value` on, the latest one of somebody who has counted before."""
        self._turns, self._before = 0, value

    def __call__(self, angle: float) -> float:
        """Return the angle with its turns, in rad."""
        if not abs(angle) < 1e6:  # NaN too
            return angle
        if self._before is not None:
            self._turns = round((self._before - angle) / (2.0 * pi))
        value = angle + 2.0 * pi * self._turns
        self._before = value
        return value
