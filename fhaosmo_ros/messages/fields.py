# SPDX-License-Identifier: Apache-2.0
"""
Which number of a message of any type is meant, and that number in message objects.

Objects are those of rclpy or of rosbags: live and replay read them alike. Definitions are those of
a rosbags typestore (``fielddefs``): by type, its constants and its fields as pairs of a name and
(kind, detail). Nodes make the same of message classes.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
import math
from math import asin, atan2, copysign, pi
from operator import attrgetter
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""How rosbags numbers the kinds of a field."""
HEADER = 'std_msgs/msg/Header'
QUATERNION = 'geometry_msgs/msg/Quaternion'
JOINT_STATE = 'sensor_msgs/msg/JointState'
ANGLES = ('roll', 'pitch', 'yaw')
"""Of a quaternion, as if they were fields of it: rotations about x, y, z (fixed axes)."""
NUMBERS = frozenset({
    'bool', 'byte', 'char', 'octet', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32',
    'int64', 'uint64', 'float32', 'float64',
})  # fmt: skip
OF_HEADERS = ('.stamp.sec', '.stamp.nanosec')
"""Ends of the names of numbers that nobody means if he does not say so."""
MOST_LISTED, LONGEST_LISTED = 10, 60
"""Names that one line lists, and letters of each: a message may have thousands."""
SUBSCRIPT = r'\[([^\[\]]+)\]'


class Elements(NamedTuple):
    """A list on the way to a number, of which the user says the element."""

    path: str  # from the message that begins the way, or from an element of the list before
    names: str  # of the list of strings beside it that names the elements, '' if there is none
    length: float  # inf where it is not fixed

    def has(self, element: str) -> bool:
        """Return False for an element that no message can have."""
        return int(element) < self.length if element.isdecimal() else bool(self.names)


Lists = tuple[Elements, ...]


class Field(NamedTuple):
    """A number in the messages of a topic."""

    text: str  # as the user wrote it: 'angular_velocity.z', 'position[2]' or 'position[elbow]'
    value: Callable[[Any], float]
    """
    Returns the number in a message object, of rclpy or of rosbags; raises `MissingElementError`
    where a list of the message is too short, or lacks the name.
    """
    header: str  # name of the std_msgs/Header that the message begins with, '' if there is none
    wraps: bool  # an angle that jumps by a whole turn, unless an `Unwrapper` follows it
    key: str  # name of the element of a list that is meant, '' if it is not meant by name

    def stamp(self, message: Any) -> int:
        """Return the stamp of the header that the message begins with, in nanoseconds."""
        stamp = getattr(message, self.header).stamp
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


class MissingElementError(ConfigurationError):
    """One message does not have the element of a list that is meant; others may."""


def listed(names: Sequence[str]) -> str:
    """Return names separated by commas, as far as one line has room for them."""
    first, more = names[:MOST_LISTED], len(names) - MOST_LISTED
    texts = [n if len(n) <= LONGEST_LISTED else f'{n[:LONGEST_LISTED]}...' for n in first]
    return ', '.join(texts) + (f' and {more} more' if more > 0 else '')


def find_field(
    types: Mapping[str, Any], message_type: str, text: str | None, name: str = ''
) -> Field:
    """
    Find a field in a message type; without a text, take the type's only number or its `data`.

    The text has names separated by dots. [index] or [name of the element] follows the name of a
    list; names are those in the list of strings beside it. roll, pitch and yaw of a quaternion.
    `name` is the element that is meant where the text ends with a list; such a text may be left
    out for a JointState, whose ``position`` it is then.

    Raises ConfigurationError if there is no such field, or it holds no number; the message lists
    the fields that do.
    """
    known = {path: (lists, angle) for path, lists, angle in _numbers(types, message_type)}
    usual = [path for path in known if not path.endswith(OF_HEADERS)]
    listing = ', '.join(usual) or 'none: it holds no number'
    if not text:
        if name and message_type == JOINT_STATE:
            text = 'position'
        elif len(usual) == 1 and '[' not in usual[0]:
            text = usual[0]
        elif 'data' in known:
            text = 'data'
        else:
            raise ConfigurationError(
                f'a field (input_field) is needed for {message_type}: expected one of '
                f'{listing}, got nothing'
            )
    path, elements = re.sub(SUBSCRIPT, '[i]', text), re.findall(SUBSCRIPT, text)
    if path not in known and name:
        path, elements = f'{path}[i]', [*elements, name]
    lists, angle = known.get(path, ((), ''))
    if path not in known or not all(map(Elements.has, lists, elements)):
        raise ConfigurationError(
            f'field {text!r}: expected a number in {message_type}, one of {listing}, got {text!r}'
            f'{suggestion(text, usual)}'
        )
    steps = [_element(text, *pair) for pair in zip(lists, elements, strict=True)]
    if end := path.rpartition('[i]')[2].removesuffix(angle).strip('.'):
        steps.append(attrgetter(end))
    if angle:
        steps.append(partial(_angle, angle))
    fields = types[message_type][1]
    has_header = bool(fields) and tuple(fields[0][1]) == (NAME, HEADER)
    key = next((e for e in reversed(elements) if not e.isdecimal()), '')
    header = fields[0][0] if has_header else ''
    return Field(text, _number(steps), header, angle in ('roll', 'yaw'), key)


def _numbers(
    types: Mapping[str, Any], message_type: str, prefix: str = '', before: Lists = ()
) -> Iterator[tuple[str, Lists, str]]:
    """Yield path, lists on the way and angle of each number of a type; [i] follows a list."""
    fields = types[message_type][1]
    names = [
        name
        for name, (kind, detail) in fields
        if kind in (ARRAY, SEQUENCE)
        and (detail[0][0], detail[0][1][0]) == (BASE, 'string')
        and (name in ('name', 'names') or name.endswith('_names'))
    ]
    within = prefix.rpartition('[i].')[2]
    for name, (kind, detail) in fields:
        path, lists = prefix + name, before
        if kind in (ARRAY, SEQUENCE):
            length = detail[1] if kind == ARRAY else math.inf
            beside = within + names[0] if names else ''
            path, lists = f'{path}[i]', (*lists, Elements(within + name, beside, length))
            kind, detail = detail[0]
        if kind == NAME and detail in types:
            yield from _numbers(types, detail, f'{path}.', lists)
        if kind == BASE and detail[0] in NUMBERS:
            yield path, lists, ''
    if message_type == QUATERNION:
        yield from ((prefix + angle, before, angle) for angle in ANGLES)


def _number(steps: list[Callable[[Any], Any]]) -> Callable[[Any], float]:
    """Return a function that goes from a message by some steps to a number."""

    def value(message: Any) -> float:
        for step in steps:
            message = step(message)
        if type(message) is float:  # at 1 kHz
            return message
        return float(message[0] if isinstance(message, bytes) else message)  # a byte of rclpy

    return value


def _element(text: str, elements: Elements, which: str) -> Callable[[Any], Any]:
    """Return the step to an element of a list, by its index or its name; `text`: the whole way."""
    values, names = attrgetter(elements.path), attrgetter(elements.names or elements.path)
    index = int(which) if which.isdecimal() else None

    def step(message: Any) -> Any:
        try:
            return values(message)[names(message).index(which) if index is None else index]
        except ValueError:
            present = listed(names(message)) or 'which has none'
            problem = f'expected a name that is in the message ({present}), got {which!r}'
        except IndexError:
            problem = f'expected a longer list, got one of {len(values(message))}'
        raise MissingElementError(f'field {text!r}: {problem}')

    return step


def _angle(angle: str, quaternion: Any) -> float:
    """Return roll, pitch or yaw of a quaternion of any length, in rad (NaN of a zero one)."""
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
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
    numbers, so their results are equal to the last bit. `near` is the latest angle of somebody
    who has counted before.
    """

    def __init__(self, near: float | None = None) -> None:
        self._before = near

    def __call__(self, angle: float) -> float:
        """Return the angle with its turns, in rad."""
        if not abs(angle) < 1e6:  # NaN too
            return angle
        turns = 0 if self._before is None else round((self._before - angle) / (2.0 * pi))
        self._before = angle + 2.0 * pi * turns
        return self._before
