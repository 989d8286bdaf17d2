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
from rosidl_parser.definition import AbstractNestedType, NamespacedType
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
    Return the class of a message type, such as 'std_msgs/msg/Float64', or raise LookupError.

    Names come from bags and from the network, and importing a module runs its code. So a package
    is imported only from where interface packages are installed: the environment's site-packages,
    or those of a sourced workspace (AMENT_PREFIX_PATH). One that lies in the working directory,
    for instance beside the bag, is not.
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
    for name in waiting:
        if name not in found:
            kind = message_class(name)
            fields = zip(kind.get_fields_and_field_types(), kind.SLOT_TYPES, strict=True)
            found[name] = [], [(field, _node(its, waiting)) for field, its in fields]
    return found


def _node(kind: Any, others: list[str]) -> Any:
    """Return the definition of a field; add the message types that it needs to `others`."""
    if isinstance(kind, AbstractNestedType):
        size = getattr(kind, 'size', 0)
        return ARRAY if size else SEQUENCE, (_node(kind.value_type, others), size)
    if isinstance(kind, NamespacedType):
        others.append('/'.join(kind.namespaced_name()))
        return NAME, others[-1]
    name = getattr(kind, 'typename', 'string')
    return BASE, (OTHER_NAMES.get(name, name), 0)
