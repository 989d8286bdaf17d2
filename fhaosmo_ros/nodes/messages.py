# SPDX-License-Identifier: Apache-2.0
"""
Messages of numbers, and their serialised form (CDR).

At 1 kHz most of a node's own time would go into making message objects and turning them into
bytes. The bytes of these messages end with their numbers, so what stands before them is made once.
"""

from array import array
from collections.abc import Callable
import math
import struct

from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64, Float64MultiArray, MultiArrayDimension, MultiArrayLayout

DOUBLE = struct.Struct('=d')
TIME = struct.Struct('=iI')
HEADER = 4
"""Bytes of CDR's header; the second one is odd for little endian."""
_BIG, _LITTLE = struct.Struct('>d').unpack_from, struct.Struct('<d').unpack_from


def labelled(names: list[str]) -> Float64MultiArray:
    """Return a one-dimensional message whose label lists its elements, such as 'z1,z2,z3'."""
    count = len(names)
    dimension = MultiArrayDimension(label=','.join(names), size=count, stride=count)
    layout = MultiArrayLayout(dim=[dimension])
    return Float64MultiArray(layout=layout, data=array('d', [0.0] * count))


def array_encoder(names: list[str]) -> Callable[[NDArray], bytes]:
    """Return a function from an array of doubles to the serialised message; see `labelled`."""
    head = serialize_message(labelled(names))[: -DOUBLE.size * len(names)]
    return lambda values: head + values.tobytes()


def double_encoder() -> Callable[[float], bytes]:
    """Return a function from a number to a serialised Float64."""
    head, pack = serialize_message(Float64())[:HEADER], DOUBLE.pack
    return lambda value: head + pack(value)


def time_encoder() -> Callable[[int], bytes]:
    """Return a function from nanoseconds to a serialised Time."""
    head, pack = serialize_message(Time())[:HEADER], TIME.pack
    return lambda stamp: head + pack(*divmod(stamp, 1_000_000_000))


def read_double(data: bytes) -> float:
    """Return the number in a serialised Float64; NaN for a message that was cut short."""
    try:
        return (_LITTLE if data[1] & 1 else _BIG)(data, HEADER)[0]
    except (IndexError, struct.error):  # rclpy's own conversion would end the node
        return math.nan
