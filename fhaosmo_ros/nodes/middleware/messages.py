# SPDX-License-Identifier: Apache-2.0
"""Messages of numbers; message classes and their definitions by name."""

from array import array
from collections.abc import Callable
from contextlib import suppress
import importlib
from importlib.util import find_spec
import os
from pathlib import Path
import re
import site
from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.messages.fields import ARRAY, BASE, NAME, SEQUENCE
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

OTHER_NAMES = {'double': 'float64', 'float': 'float32', 'boolean': 'bool'}
"""IDL's names, which classes have, and those of ROS."""


def labelled(names: list[str]) -> Callable[[NDArray], Float64MultiArray]:
    """
    Return a function from doubles to a message whose label lists them, such as 'z1,z2,z3'.

    It is one message, filled again and again: to make one takes longer than a step.
    """
    count, message = len(names), Float64MultiArray()
    message.layout.dim = [MultiArrayDimension(label=','.join(names), size=count, stride=count)]

    def filled(values: NDArray) -> Float64MultiArray:
        message.data = array('d', values.tobytes())
        return message

    return filled


def time_message(stamp: int, message: Time | None = None) -> Time:
    """Return a time in nanoseconds as a message, a new one or the one that is given."""
    message = message or Time()
    message.sec, message.nanosec = divmod(stamp, 1_000_000_000)
    return message


def message_class(name: str) -> Any:
    """
    Return the class of a message type, such as 'std_msgs/msg/Float64'.

    Names come from bags and from the network, and importing a module runs its code. So a package
    is imported only from where interface packages are installed: the environment's site-packages,
    or those of a sourced workspace (AMENT_PREFIX_PATH). One that lies in the working directory,
    for instance beside the bag, is not.

    Raises
    ------
    LookupError
        No such message type is installed.

    """
    found = re.fullmatch(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)', name)
    if found and _is_installed(found[1]):
        with suppress(ImportError, AttributeError):
            return getattr(importlib.import_module(f'{found[1]}.msg'), found[2])
    raise LookupError(
        'expected a message type that is installed here, written as in std_msgs/msg/Float64, '
        f'got {name}'
    )


def _is_installed(package: str) -> bool:
    """Return True for a package of messages in site-packages; finding it does not run its code."""
    spec = find_spec(package)
    if not (spec and spec.origin and Path(spec.origin).with_name('msg').is_dir()):
        return False
    folder = Path(spec.origin).parents[1].resolve()
    own = [Path(path).resolve() for path in (*site.getsitepackages(), site.getusersitepackages())]
    if folder in own:
        return True
    prefixes = filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
    in_workspace = any(folder.is_relative_to(Path(prefix).resolve()) for prefix in prefixes)
    return in_workspace and folder.name in ('site-packages', 'dist-packages')


def definitions(message_type: str) -> dict[str, Any]:
    """Return the definitions, as `find_field` reads them, of a message type and all in it."""
    found: dict[str, Any] = {}
    waiting = [message_type]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        fields = message_class(name).get_fields_and_field_types()
        found[name] = [], [(field, _node(text, waiting)) for field, text in fields.items()]
    return found


def _node(text: str, others: list[str]) -> Any:
    """Return the definition of a field; add the message types that it needs to `others`."""
    if inner := re.fullmatch(r'sequence<(.+?)(?:, *(\d+))?>', text):
        return SEQUENCE, (_node(inner[1], others), int(inner[2] or 0))
    if inner := re.fullmatch(r'(.+)\[(\d+)\]', text):
        return ARRAY, (_node(inner[1], others), int(inner[2]))
    if '/' in text:
        name = text.replace('/', '/msg/')
        others.append(name)
        return NAME, name
    kind = re.sub(r'<\d+>', '', text)  # string<10>
    return BASE, (OTHER_NAMES.get(kind, kind), 0)
