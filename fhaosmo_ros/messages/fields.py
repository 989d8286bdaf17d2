# SPDX-License-Identifier: Apache-2.0
"""
Which number of a message of any type is meant, and that number in message objects.

Objects are those of rclpy or of rosbags: live and replay read them alike. Definitions are those of
a rosbags typestore (``fielddefs``): by type, its constants and its fields as pairs of a name and
(kind, detail). Nodes make the same of message classes.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import math
from math import asin, atan2, copysign, pi
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


class Key(NamedTuple):
    """An element of a list by its name, which stands in another list of the same message."""

    name: str
    names: str  # field with the names, beside the list


class Elements(NamedTuple):
    """A list in the way to a number, of which the user says the element."""

    length: float  # inf where it is not fixed
    names: str  # field beside it that holds the elements' names, '' if there is none

    def element(self, text: str) -> int | Key | None:
        """Return the element that is meant, None if there is no such one."""
        if text.isdigit():
            return int(text) if int(text) < self.length else None
        return Key(text, self.names) if self.names else None


class Field(NamedTuple):
    """A number in the messages of a topic."""

    text: str  # as the user wrote it: 'angular_velocity.z', 'position[2]' or 'position[elbow]'
    steps: list[str | int | Key]  # fields and elements of lists, from the message inwards
    header: str  # name of the std_msgs/Header that the message begins with, '' if there is none
    angle: str = ''  # one of `ANGLES` where the steps lead to the x of a quaternion, else ''

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
        around = node = message
        try:
            for step in self.steps:
                if isinstance(step, str):
                    around, node = node, getattr(node, step)
                elif isinstance(step, Key):
                    names = getattr(around, step.names)
                    node = node[names.index(step.name)]
                else:
                    node = node[step]
        except ValueError:
            raise MissingElementError(
                f'field {self.text!r}: expected a name that is in the message '
                f'({listed(names) or "which has none"}), got {step.name!r}'
            ) from None
        except IndexError:
            raise MissingElementError(
                f'field {self.text!r}: expected a longer list, got one of {len(node)}'
            ) from None
        if self.angle:
            return angle_of(self.angle, around.x, around.y, around.z, around.w)
        return float(node[0] if isinstance(node, bytes) else node)  # a byte of rclpy

    def reader(self) -> Callable[[Any], float]:
        """Return `value`, or the same for an element by its name in half the time."""
        if [type(step) for step in self.steps] != [str, Key]:
            return self.value
        elements, (name, names), value = self.steps[0], self.steps[1], self.value

        def read(message: Any) -> float:
            try:
                found = getattr(message, elements)[getattr(message, names).index(name)]
            except (ValueError, IndexError):
                return value(message)  # which says what is wrong
            return found if isinstance(found, float) else value(message)

        return read

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
    known = {path: (steps, angle) for path, steps, angle in _numbers(types, message_type)}
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
    steps, angle = known.get(path, ((None,), ''))  # None: there is no such number
    wanted = iter(elements)
    found = [s.element(next(wanted)) if isinstance(s, Elements) else s for s in steps]
    if None in found:
        raise ConfigurationError(
            f'field {text!r}: expected a number in {message_type}, one of {listing}, got {text!r}'
            f'{suggestion(text, usual)}'
        )
    fields = types[message_type][1]
    has_header = bool(fields) and tuple(fields[0][1]) == (NAME, HEADER)
    return Field(text, found, fields[0][0] if has_header else '', angle)


def _numbers(
    types: Mapping[str, Any], message_type: str, prefix: str = '', before: tuple[Any, ...] = ()
) -> Iterator[tuple[str, tuple[Any, ...], str]]:
    """Yield path, steps and angle of each number of a type; a list is [i] in a path."""
    fields = types[message_type][1]
    names = [
        name
        for name, (kind, detail) in fields
        if kind in (ARRAY, SEQUENCE)
        and (detail[0][0], detail[0][1][0]) == (BASE, 'string')
        and (name in ('name', 'names') or name.endswith('_names'))
    ]
    for name, (kind, detail) in fields:
        path, steps = prefix + name, (*before, name)
        if kind in (ARRAY, SEQUENCE):
            length = detail[1] if kind == ARRAY else math.inf
            path, steps = f'{path}[i]', (*steps, Elements(length, names[0] if names else ''))
            kind, detail = detail[0]
        if kind == NAME and detail in types:
            yield from _numbers(types, detail, f'{path}.', steps)
        if kind == BASE and detail[0] in NUMBERS:
            yield path, steps, ''
    if message_type == QUATERNION:
        yield from ((prefix + angle, (*before, 'x'), angle) for angle in ANGLES)


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
