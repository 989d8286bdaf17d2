# SPDX-License-Identifier: Apache-2.0
"""
Arrays that compiled code uses without counting references.

numba counts references atomically each time an array is handed from function to function, which
costs more than the arithmetic of a step. A compiled function whose caller keeps its arrays alive
for the whole call can use them without an owner instead.
"""

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import carray, njit, types  # type: ignore[attr-defined]
from numba.extending import intrinsic
import numpy as np
from numpy.typing import NDArray


def _unowned(typing_context: Any, value: Any) -> Any:
    """Return the same array, or (named) tuple of arrays, without an owner."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _without_owner(context, builder, signature.args[0], arguments[0])

    return value(value), generate


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Write the code that removes the reference to the owner from every array in `value`."""
    if isinstance(kind, types.Array):
        view = context.make_array(kind)(context, builder, value)
        view.meminfo = view.meminfo.type(None)
        return view._getvalue()
    if isinstance(kind, types.BaseTuple):
        members: Any = kind
        parts = [
            _without_owner(context, builder, member, builder.extract_value(value, index))
            for index, member in enumerate(members)
        ]
        return context.make_tuple(builder, kind, parts)
    return value


unowned: Any = intrinsic(_unowned)
"""
Return an array, or a (named) tuple of arrays and numbers, without owners: for compiled code only.

The result is valid while the caller's arrays live.
"""


def _pointer_to(kind: Any) -> Any:
    """Return an intrinsic that makes a pointer of an address."""
    pointer_type: Any = types.CPointer

    def pointer(typing_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return pointer_type(kind)(types.int64), generate

    return intrinsic(pointer)


_double_pointer, _integer_pointer = _pointer_to(types.float64), _pointer_to(types.int64)


@njit(error_model='numpy', inline='always')
def doubles_at(address: int, shape: Any) -> Any:
    """Return the contiguous float64 array at an address, which its owner keeps alive."""
    return carray(_double_pointer(address), shape)


@njit(error_model='numpy', inline='always')
def integers_at(address: int, shape: Any) -> Any:
    """Return the contiguous int64 array at an address, which its owner keeps alive."""
    return carray(_integer_pointer(address), shape)


def table_of(arrays: Sequence[NDArray[Any]]) -> NDArray[np.int64]:
    """
    Return where arrays of doubles or integers lie: address, rows (0 of a line), columns of each.

    Raises
    ------
    AssertionError
        One is not contiguous.

    """
    for index, array in enumerate(arrays):
        if not array.flags.c_contiguous:
            raise AssertionError(f'array {index} is not contiguous')
    rows = [array.shape[0] if array.ndim == 2 else 0 for array in arrays]
    return np.array([(a.ctypes.data, r, a.shape[-1]) for a, r in zip(arrays, rows, strict=True)])


@njit(error_model='numpy', inline='always')
def plane_at(t: Any, index: int) -> Any:
    """Return the two-dimensional array that row `index` of a table names."""
    return doubles_at(t[index, 0], (t[index, 1], t[index, 2]))


@njit(error_model='numpy', inline='always')
def line_at(t: Any, index: int) -> Any:
    """Return the array of doubles that row `index` of a table names."""
    return doubles_at(t[index, 0], t[index, 2])


@njit(error_model='numpy', inline='always')
def integers_of(t: Any, index: int) -> Any:
    """Return the array of integers that row `index` of a table names."""
    return integers_at(t[index, 0], t[index, 2])


def _call_at(
    typing_context: Any, address: Any, table: Any, y: Any, h: Any, inputs: Any, count: Any
) -> Any:
    """Return an intrinsic that calls a function by its address."""
    integer, double = types.int64, types.float64

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integers, doubles = context.get_value_type(integer), context.get_value_type(double)
        kinds = [integers, doubles, doubles, integers, integers]
        kind = ir.FunctionType(doubles, kinds)
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])

    return double(integer, integer, double, double, integer, integer), generate


call_at: Any = intrinsic(_call_at)
"""
Call the function at an address with (table, y, h, address of the inputs, their count).

For compiled code only; see `compiled_callback`.
"""
