# SPDX-License-Identifier: Apache-2.0
"""
Expressions as bytecode, and its compiled interpreter: value and exact derivative in one pass.

Bytecode is plain data (operation codes and numbers in postfix order), so a model from a YAML file
needs no code generation: nothing is compiled when a node starts, and nothing from outside is ever
executed. The derivative along dz is carried by forward-mode differentiation (dual numbers).
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
import numpy as np
from numpy.typing import NDArray

CONST, STATE, INPUT = 0, 1, 2
ADD, SUB, MUL, DIV, POW, ATAN2, MIN, MAX = 3, 4, 5, 6, 7, 8, 9, 10
NEG, SIN, COS, TAN, EXP, LOG, SQRT, ABS, TANH, SIGN = 11, 12, 13, 14, 15, 16, 17, 18, 19, 20

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Bytecode(NamedTuple):
    """
    Several expressions, one behind the other.

    Attributes
    ----------
    code : (T, 2) array
        Operation codes, and the constant, state or input index that belongs to each.
    offsets : (count + 1,) array
        Expression i occupies ``code[offsets[i]:offsets[i + 1]]``; an empty one is the constant 0.

    """

    code: Floats
    offsets: Ints


def is_linear(tokens: Sequence[tuple[int, float]]) -> bool:
    """Return True if an expression is sums of states times numbers, and of anything else."""
    # 0: a number, 1: a number or known inputs, 2: linear in the states, 3: anything else
    stack: list[int] = []
    for code, _ in tokens:
        if code <= INPUT:
            stack.append({CONST: 0, INPUT: 1, STATE: 2}[int(code)])
        elif code <= MAX:
            b, a = stack.pop(), stack.pop()
            most = max(a, b)
            is_kept = (
                code in (ADD, SUB) or (code == MUL and 0 in (a, b)) or (code == DIV and b == 0)
            )
            stack.append(most if is_kept or most < 2 else 3)
        else:
            a = stack.pop()
            stack.append(a if code == NEG or a < 2 else 3)
    return max(stack, default=0) < 3


@compiled(forceinline=True)
def evaluate(
    expressions: Bytecode, i: int, z: Floats, u: Floats, stack: Floats
) -> tuple[float, float]:
    """
    Evaluate expression i and its derivative along dz.

    Parameters
    ----------
    expressions : Bytecode
    i : int
        0 for Phi_1.
    z : (2, > i) array
        States z_1 .. z_{i+1}, and their tangent dz.
    u : (m,) array
        Known inputs; their tangent is 0.
    stack : (2, depth) array
        Scratch memory for values and slopes.

    Returns
    -------
    (float, float)
        Phi(z, u) and dPhi/dz . dz. Outside its domain an operation gives NaN or infinity.

    """
    tape, top = expressions.code, -1
    for k in range(expressions.offsets[i], expressions.offsets[i + 1]):
        code = int(tape[k, 0])
        if code <= INPUT:
            top += 1
            if code == CONST:
                stack[0, top], stack[1, top] = tape[k, 1], 0.0
            elif code == STATE:
                j = int(tape[k, 1])
                stack[0, top], stack[1, top] = z[0, j], z[1, j]
            else:
                stack[0, top], stack[1, top] = u[int(tape[k, 1])], 0.0
        elif code <= MAX:
            b, db = stack[0, top], stack[1, top]
            top -= 1
            a, da = stack[0, top], stack[1, top]
            if code == ADD:
                stack[0, top], stack[1, top] = a + b, da + db
            elif code == SUB:
                stack[0, top], stack[1, top] = a - b, da - db
            elif code == MUL:
                stack[0, top], stack[1, top] = a * b, da * b + a * db
            elif code == DIV:
                v = a / b
                stack[0, top], stack[1, top] = v, (da - v * db) / b
            elif code == POW:
                v = np.power(a, b)
                d = 0.0
                if da != 0.0 and b != 0.0:
                    d += b * np.power(a, b - 1.0) * da
                if db != 0.0 and v != 0.0:
                    d += v * np.log(a) * db
                stack[0, top], stack[1, top] = v, d
            elif code == ATAN2:
                r = math.hypot(a, b)  # a is sin, b is cos of the angle, times r
                d = (b / r * da - a / r * db) / r if da != 0.0 or db != 0.0 else 0.0
                stack[0, top], stack[1, top] = math.atan2(a, b), d
            elif a == b:  # the middle of the subdifferential, as for abs
                stack[1, top] = 0.5 * (da + db)
            elif b != b or (b < a if code == MIN else b > a):  # else a stays, NaN too
                stack[0, top], stack[1, top] = b, db
        else:
            a, da = stack[0, top], stack[1, top]
            if code == NEG:
                stack[0, top], stack[1, top] = -a, -da
            elif code == SIN:
                stack[0, top], stack[1, top] = math.sin(a), math.cos(a) * da
            elif code == COS:
                stack[0, top], stack[1, top] = math.cos(a), -math.sin(a) * da
            elif code == TAN:
                v = math.tan(a)
                stack[0, top], stack[1, top] = v, (1.0 + v * v) * da
            elif code == EXP:
                v = np.exp(a)
                stack[0, top], stack[1, top] = v, v * da
            elif code == LOG:
                stack[0, top], stack[1, top] = np.log(a), (da / a if da != 0.0 else 0.0)
            elif code == SQRT:
                v = np.sqrt(a)
                stack[0, top], stack[1, top] = v, (0.5 * da / v if da != 0.0 else 0.0)
            elif code == ABS:
                stack[0, top], stack[1, top] = abs(a), np.sign(a) * da
            elif code == TANH:
                v = math.tanh(a)
                stack[0, top], stack[1, top] = v, (1.0 - v * v) * da
            else:
                stack[0, top], stack[1, top] = np.sign(a), 0.0
    if top < 0:
        return 0.0, 0.0
    return stack[0, 0], stack[1, 0]
