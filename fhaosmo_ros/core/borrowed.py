# SPDX-License-Identifier: Apache-2.0
"""
Arrays that compiled code uses without counting references.

numba counts references atomically each time an array is handed from function to function, which
costs more than the arithmetic of a step. A compiled function whose caller keeps its arrays alive
for the whole call can borrow them instead.
"""

from typing import Any

from numba.extending import intrinsic


def _borrowed(typing_context: Any, array: Any) -> Any:
    """Return the same array without an owner; valid while the caller's array lives."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        view = context.make_array(signature.args[0])(context, builder, arguments[0])
        view.meminfo = view.meminfo.type(None)
        return view._getvalue()

    return array(array), generate


borrowed: Any = intrinsic(_borrowed)
