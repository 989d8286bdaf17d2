# SPDX-License-Identifier: Apache-2.0
"""Messages that carry arrays of doubles."""

from array import array

from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout


def labelled(names: list[str]) -> Float64MultiArray:
    """Return a one-dimensional message whose label lists its elements, such as 'z1,z2,z3'."""
    count = len(names)
    dimension = MultiArrayDimension(label=','.join(names), size=count, stride=count)
    layout = MultiArrayLayout(dim=[dimension])
    return Float64MultiArray(layout=layout, data=array('d', [0.0] * count))


def fill(message: Float64MultiArray, values: NDArray) -> Float64MultiArray:
    """Put `values` into a message; rclpy takes an array.array without looking at each element."""
    message.data = array('d', values.tobytes())
    return message
